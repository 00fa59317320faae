"""wire listen on real ttys, boards of other packages, and what holds for every program of wire."""
import os
import pty
import re
import signal
import struct
import subprocess
import sys
from functools import partial

import pytest
from lines import Pty
from programs import started
from waiting import PATIENCE, until

from crane_scale import wire as scale
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.framing.announcement import chunks_of
from serial_communication.transport.port import Port
from wire_lines import ROOT

pytestmark = pytest.mark.slow
PROGRAM = [sys.executable, ROOT + '/scripts/wire']
PLAIN = {key: value for key, value in os.environ.items() if key != 'PYTHONUNBUFFERED'}


class Program:
    """A running program, with its output in files."""

    def __init__(self, folder, *arguments):
        self.paths = [folder / 'stdout', folder / 'stderr']
        with open(self.paths[0], 'w') as output, open(self.paths[1], 'w') as errors:
            self.process = subprocess.Popen(PROGRAM + [str(each) for each in arguments],
                                            stdout=output, stderr=errors, cwd=str(folder))

    def lines(self):
        return self.paths[0].read_text().splitlines()

    def stderr(self):
        return self.paths[1].read_text()

    def wait_for_line(self, words, count=1):
        until(lambda: self.stderr().count(words) >= count, words)

    def shown(self, board, data, count):
        """Write data to a port; return the lines of the program when there are so many."""
        board.write(data)
        return until(lambda: len(self.lines()) == count and self.lines(), f'{count} lines')

    def end(self, number=signal.SIGINT):
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.process.wait(PATIENCE)


@pytest.fixture
def start(tmp_path):
    yield from started(partial(Program, tmp_path))


@pytest.fixture
def board(tmp_path):
    one = Pty(tmp_path / 'board').plug()
    yield one
    one.unplug()


def run(*arguments, **options):
    return subprocess.run(PROGRAM + [str(each) for each in arguments], timeout=PATIENCE, text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options)


def status(number):
    return mcu.encode(mcu.SensorStatus(number, 500, 30.0, 4.0, 5.0), number % 256)


# -- listen ---------------------------------------------------------------------------------------

def test_listen_shows_every_frame_and_writes_nothing(board, start):
    program = start('listen', 'mcu', board.path)
    program.wait_for_line('open')
    lines = program.shown(board, status(1) + b'\x11\x22' + status(2) + status(3)[:7], 4)
    found = [re.fullmatch(r'\d\d:\d\d:\d\d\.\d{6} +(\+\S+ u?m?s)? +((?:[0-9a-f]{2} )+) +(.*)', line)
             for line in lines]
    assert [bytes.fromhex(each.group(2)) for each in found] == [
        status(1), b'\x11\x22', status(2), status(3)[:7]]
    assert [each.group(1) is None for each in found] == [True, False, False, False]
    assert [each.group(3).startswith('framing: ') for each in found] == [False, True, False, True]
    assert found[0].group(3).startswith('sensor status: 1 mm 500 mm')
    assert board.read() == b''
    assert program.end() == 0
    assert '4 frames, 2 of them invalid' in program.stderr()


def test_listen_waits_for_a_port_and_opens_it_again(tmp_path, start):
    board = Pty(tmp_path / 'late')
    program = start('listen', 'mcu', board.path)
    program.wait_for_line('waiting for it')
    for count in (1, 2):
        board.plug()
        program.wait_for_line('late: open', count)
        program.shown(board, status(count), count)
        board.unplug()
        program.wait_for_line('the device has gone', count)
    assert program.end(signal.SIGTERM) == 0


def test_announced_messages_are_learned(board, start):
    text = (b'firmware: nano 1\nforce: {type: 32, ros_type: any/Type, layout: "<h", '
            b'fields: [data], scale: 0.01}\nwrong: {typ: 5}\n')
    force = arduino.encode_raw(32, (1234).to_bytes(2, 'little'))
    program = start('listen', 'arduino', board.path)
    program.wait_for_line('open')
    program.shown(board, force + b''.join(map(arduino.encode, chunks_of(text, 40))), 4)
    lines = program.shown(board, force, 5)
    assert 'message type 32 is unknown' in lines[0] and 'announcement 1/3' in lines[1]
    assert lines[4].endswith('force data=12.34')


def test_announced_settings_are_learned(board, start):
    text = b'kp: {setting: 1, layout: "<f", unit: "1/s"}\n'
    setting = mcu.encode_raw(253, 1, b'\1' + struct.pack('<f', 2.2))
    program = start('listen', 'mcu', board.path)
    program.wait_for_line('open')
    chunk, = chunks_of(text, 60)
    program.shown(board, setting + mcu.encode(chunk, 2), 2)
    lines = program.shown(board, setting, 3)
    assert 'setting number=1 [205 204 12 64]' in lines[0]
    assert lines[2].endswith('setting number=1 kp=2.2 1/s')


def test_listen_tells_where_the_frames_of_a_bridge_are(board):
    port = Port(board.path)
    port.open()
    done = run('listen', 'mcu', board.path)
    port.close()
    assert done.returncode == 1
    assert 'rostopic echo /serial_msg' in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_listen_ends_quietly_when_its_output_is_closed(board):
    program = subprocess.Popen(PROGRAM + ['listen', 'mcu', board.path], stdout=subprocess.PIPE,
                               stderr=subprocess.PIPE, text=True)
    program.stdout.close()
    assert ': open' in program.stderr.readline()
    until(lambda: program.poll() is not None, 'it ends', doing=lambda: board.write(status(1)))
    assert program.returncode == 0 and program.stderr.read() == ''
    program.stderr.close()


def test_listen_ends_on_a_full_disk(board):
    with open('/dev/full', 'w') as full:
        program = subprocess.Popen(PROGRAM + ['listen', 'mcu', board.path], stdout=full,
                                   stderr=subprocess.PIPE, text=True)
    assert ': open' in program.stderr.readline()
    until(lambda: program.poll() is not None, 'it ends', doing=lambda: board.write(status(1)))
    assert program.stderr.read() == 'wire: its output cannot be written: No space left on device\n'
    program.stderr.close()
    assert program.returncode == 1


# -- a board of another package -------------------------------------------------------------------

HOLD = scale.encode(scale.Hold(), 0)


def load_frame(number):
    return scale.encode(scale.Load(number / 10), number % 256)


@pytest.fixture
def scale_config(tmp_path, monkeypatch):
    """Parameters of a bridge with the scale; its package is put on the programs' PYTHONPATH."""
    monkeypatch.setenv('PYTHONPATH', os.pathsep.join(
        [os.path.dirname(os.path.abspath(__file__)), os.environ.get('PYTHONPATH', '')]))
    path = tmp_path / 'scale.yaml'
    path.write_text('boards: [crane_scale]\n'
                    'scale: {messages: {tilt: {type: 3, ros_type: std_msgs/Float32, '
                    'layout: "<h", fields: [data], scale: 0.01}}}\n')
    return path


def test_another_board_is_explained_by_its_package_and_by_its_link(scale_config):
    both = HOLD.hex() + load_frame(123).hex()
    by_package = run('explain', 'crane_scale', both)
    assert by_package.returncode == 0, by_package.stderr
    assert re.search(r'3a 31 30 37 62 .* frame +load 12.3 kg', by_package.stdout)
    assert run('explain', 'scale', both, '--config', scale_config).stdout == by_package.stdout
    tilt = scale.encode_raw(b'\3\7\x64\0')
    done = run('explain', 'scale', '--config', scale_config, tilt.hex())
    assert done.returncode == 0 and 'frame             tilt data=1\n' in done.stdout
    done = run('explain', 'crane_scale', tilt.hex(), load_frame(5).hex()[:-2])
    assert done.returncode == 1
    assert 'the unknown type 0x03' in done.stdout and 'incomplete' in done.stdout


@pytest.mark.parametrize('by_config', (False, True), ids=('by its package', 'by its link'))
def test_listen_and_play_know_another_board(scale_config, board, start, tmp_path, by_config):
    link = ['scale', '--config', scale_config] if by_config else ['crane_scale']
    program = start('listen', *link, board.path)
    program.wait_for_line('open')
    lines = program.shown(board, load_frame(1) + b'\x11' + load_frame(4), 3)
    assert lines[0].endswith('load 0.1 kg') and lines[2].endswith('load 0.4 kg')
    assert '1 byte outside frames' in lines[1]
    assert program.end() == 0
    done = run('play', tmp_path / 'stdout', *link, board.path)
    assert done.returncode == 0 and board.read_all() == load_frame(1) + load_frame(4)


@pytest.mark.parametrize('arguments', [
    ['explain', 'scale', '0200'], ['explain', 'json', '0200'], ['explain', 'no.such.board', '02'],
    ['listen', 'scale', '/dev/null'], ['play', 'x', 'scale', '/dev/null']], ids=' '.join)
def test_an_unknown_board_is_reported_in_one_line(arguments):
    done = run(*arguments)
    assert done.returncode == 2 and not done.stdout
    assert done.stderr.startswith('wire: there is no board ') and '--config' in done.stderr
    assert len(done.stderr.splitlines()) == 1


# -- the program ----------------------------------------------------------------------------------

def test_config_makes_custom_messages_known(tmp_path):
    config = os.path.join(ROOT, 'config', 'custom_messages.yaml')
    done = run('explain', 'arduino', '--config', config, '0420f40100')
    assert done.returncode == 0 and 'force' in done.stdout and '(sent as 500)' in done.stdout
    assert run('explain', 'arduino', '0420f40100').returncode == 1
    wrong = tmp_path / 'wrong.yaml'
    wrong.write_text('arduino: {messages: {force: {type: 4}}}')
    for path in wrong, tmp_path / 'missing.yaml':
        done = run('explain', 'arduino', '--config', path, '0420f40100')
        assert done.returncode == 2 and len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize('program', ['explain', 'listen', 'play'])
def test_help_names_the_program(program):
    done = run(program, '--help')
    assert done.returncode == 0 and f'wire {program}' in done.stdout and not done.stderr
    assert run('--help').stdout.count(f'wire {program}') == 1


@pytest.mark.parametrize('arguments', [
    [], ['dance'], ['listen'], ['listen', 'mcu'], ['listen', 'mcu', 'nonsense://x'], ['play', 'a'],
    ['play', 'a', 'mcu', 'b', '--rate', '2'], ['listen', 'mcu', '/dev/null', '--baud', '0'],
    ['tap', 'mcu', '/dev/null', '/dev/zero'], ['explain', 'mcu', '02', '--dance']], ids=' '.join)
def test_wrong_arguments_give_status_2(arguments):
    done = run(*arguments)
    assert done.returncode == 2 and 'Traceback' not in done.stderr


@pytest.mark.parametrize('arguments', [['explain', 'mcu', '02 0c'], ['--help']], ids=' '.join)
def test_a_full_disk_is_reported_in_one_line(arguments):
    with open('/dev/full', 'w') as full:
        done = subprocess.run(PROGRAM + arguments, stdout=full, stderr=subprocess.PIPE, text=True,
                              timeout=PATIENCE, env=PLAIN)
    assert done.returncode == 1
    assert done.stderr == 'wire: its output cannot be written: No space left on device\n'


BLOCKER = '''
import runpy, sys
class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.split('.')[0] in ('rospy', 'genpy', 'yaml', 'rosbag', 'roslib', 'rospkg',
                                  'rosgraph', 'numpy'):
            raise ImportError(f'{name} is not installed here')
sys.meta_path.insert(0, Blocker())
sys.argv[0] = 'wire'
runpy.run_module('serial_communication.tools.wire', run_name='__main__', alter_sys=True)
'''


@pytest.mark.parametrize('arguments, returned, words', [
    (['explain', 'bus', 'a50002a7'], 0, ''), (['--help'], 0, ''),
    (['listen', 'mcu', '/dev/null'], 1, 'this is not a serial port'),
    (['play', 'a.bag', 'mcu', '/dev/null'], 1, 'python3-rosbag')])
def test_pyserial_alone_is_enough_except_for_bags(tmp_path, arguments, returned, words):
    (tmp_path / 'a.bag').write_bytes(b'#ROSBAG V2.0\n')
    done = subprocess.run([sys.executable, '-c', BLOCKER] + arguments, cwd=str(tmp_path),
                          timeout=PATIENCE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                          text=True, env={'PATH': os.environ['PATH'], 'PYTHONPATH': ROOT})
    assert done.returncode == returned and words in done.stderr
    assert len(done.stderr.splitlines()) <= 1, done.stderr


def test_colours_are_for_terminals_only():
    shown = {}
    for environment in ({'TERM': 'xterm'}, {'TERM': 'xterm', 'NO_COLOR': '1'}, {'TERM': 'dumb'}):
        near, far = pty.openpty()
        done = subprocess.Popen(PROGRAM + ['explain', 'mcu', '02 0c'], stdout=far,
                                env=dict(os.environ, **environment))
        assert done.wait(PATIENCE) == 1
        shown[str(environment)] = b'\033[' in os.read(near, 65536)
        os.close(near)
        os.close(far)
    assert list(shown.values()) == [True, False, False]
