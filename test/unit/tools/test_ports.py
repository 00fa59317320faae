"""The program `ports`, on pseudo terminals with simple boards: what it finds."""
import getpass
import itertools
import json
import os
import pty
import random
import shutil
import subprocess
import sys
import termios
import threading
import tty

import pytest
import yaml

import crane_scale
from serial_communication.boards import description
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.mcu import wire as mcu
from serial_communication.tools.ports import advice, cli
from serial_communication.tools.ports.holders import Holder, holders_of
from serial_communication.tools.ports.listening import Candidate
from waiting import until

pytestmark = pytest.mark.slow      # the program listens for seconds
HERE = os.path.dirname(os.path.abspath(__file__))
ROOT = os.path.dirname(os.path.dirname(os.path.dirname(HERE)))
PROGRAM = os.path.join(ROOT, 'scripts', 'ports')
SYNC = bus.encode_request(bus.SYNC_REQUEST)
MCU = b''.join(mcu.encode(mcu.SensorStatus(40, seq, 1.0, 2.0, 3.0), seq) for seq in range(10))
CAR = b''.join(arduino.encode(each) for each in (arduino.Ticks(3), arduino.SteeringAngle(500)))
SCALE = b''.join(crane_scale.wire.encode(crane_scale.wire.Load(5.0), seq) for seq in range(3))
NOISE = random.Random(1).getrandbits(800).to_bytes(100, 'big')


class Board:
    """The other end of a port: sends `data` all the time, or answers SYNC.

    Args:
        each: sent in turn, in place of `data`.
        baud: the rate at which it sends; at another one the port receives noise.
    """

    def __init__(self, path, data=b'', baud=115200, answers=False, each=()):
        self.path = str(path)
        self.received = b''
        self._turns = itertools.cycle(each or [data])
        self._speed = getattr(termios, f'B{baud}')
        self._answers = answers
        self._fd, slave = pty.openpty()
        tty.setraw(slave)
        os.symlink(os.ttyname(slave), self.path)
        os.close(slave)
        os.set_blocking(self._fd, False)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name='board')
        self._thread.start()

    def close(self):
        self._ending.set()
        self._thread.join()
        os.close(self._fd)

    def _run(self):
        while not self._ending.wait(0.01):
            try:
                request = os.read(self._fd, 1000)
            except OSError:     # nothing to read, or nobody has the port open
                request = b''
            self.received += request
            data = next(self._turns)
            if self._answers and request == SYNC:
                data = bus.encode_reply(bus.Reply(bus.SYNC))
            if data and termios.tcgetattr(self._fd)[5] != self._speed:
                data = NOISE[:len(data)]
            try:
                os.write(self._fd, data)
            except OSError:     # the port is full
                pass


@pytest.fixture
def board(tmp_path):
    """A function that makes a board on a port, tmp_path/NAME."""
    made = []

    def make(name, *arguments, **options):
        made.append(Board(tmp_path / name, *arguments, **options))
        return made[-1]

    yield make
    for each in made:
        each.close()


def run(*arguments):
    return subprocess.run([sys.executable, PROGRAM, '--seconds', '0.5', *map(str, arguments)],
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE, encoding='utf-8',
                          env={**os.environ, 'PYTHONPATH': os.pathsep.join(
                              [HERE, os.environ.get('PYTHONPATH', '')])}, timeout=100)


def to_paste(text):
    """The configuration that the last lines are."""
    return yaml.safe_load(text.partition('\nPut into a configuration (')[2].partition('\n')[2])


def found(*arguments):
    """The objects that it prints with --json, by the name of the port."""
    done = run('--json', *arguments)
    assert done.returncode == 0, done.stderr
    return {os.path.basename(each['port']): each for each in json.loads(done.stdout)}


def test_boards_are_found_and_nothing_is_written(board, tmp_path):
    boards = [board('one', MCU), board('two', CAR), board('three', answers=True),
              board('four', b'boot: ok\r\n')]
    done = run(*(each.path for each in boards), tmp_path / 'absent')
    assert [each.received for each in boards] == [b''] * 4
    assert f'{boards[0].path}  mcu (sensor board)\n' in done.stdout
    assert f'{boards[2].path}  silent\n' in done.stdout
    assert f'{boards[3].path}  bytes of no known board, at no usual baud rate\n' in done.stdout
    assert "(text: 'boot: ok" in done.stdout and 'there is no such device' in done.stdout
    assert 'board is silent until it is asked: run this again with --ask\n' in done.stdout
    assert to_paste(done.stdout) == {'arduino': {'port': boards[1].path, 'baud': 115200},
                                     'mcu': {'port': boards[0].path, 'baud': 115200}}


def test_only_silent_ports_are_asked_and_only_for_a_sync(board, tmp_path):
    boards = [board('one', MCU), board('two', answers=True), board('three', NOISE), board('four')]
    ports = found('--ask', *(each.path for each in boards), tmp_path / 'absent')
    assert {name: (port['board'], port['heard'], port['baud'], port['held_by'])
            for name, port in ports.items()} == {
        'one': ('mcu', 'frames', 115200, None), 'two': ('bus', 'frames', 115200, None),
        'three': (None, 'noise', None, None), 'four': (None, 'nothing', None, None),
        'absent': (None, 'nothing', None, None)}
    assert ports['one']['port'] == boards[0].path
    assert ports['absent']['trouble'] == 'there is no such device'
    until(lambda: boards[3].received == SYNC * 3, 'the silent board has received all')
    assert [each.received for each in boards] == [b'', SYNC, b'', SYNC * 3]


@pytest.mark.parametrize('data, name, baud, configured', [
    (MCU, 'mcu', 57600, ''), (CAR, 'arduino', 2400, '2400'), (CAR, 'arduino', 115200, '2400'),
    (b'', 'bus', 2400, '2400')])
def test_another_baud_rate_is_found(board, tmp_path, data, name, baud, configured):
    """A usual one, or one that only the configuration has; likewise if a board is asked."""
    config = tmp_path / 'base.yaml'
    config.write_text(f'{name}: {{baud: {configured}}}' if configured else '{}')
    path = board('port', data, baud=baud, answers=not data).path
    text = run('--config', config, '--ask', path).stdout
    assert f'{name} ({description(name).title})' in text
    assert (f', at {baud} baud' in text) == (baud != 115200)
    assert to_paste(text) == {name: {'port': path, 'baud': baud}}


def test_a_board_of_another_package_is_found(board, tmp_path):
    config = tmp_path / 'base.yaml'
    config.write_text('boards: [crane_scale]\n')
    path = board('port', SCALE, baud=9600).path
    assert to_paste(run('--config', config, path).stdout) == {'scale': {'port': path, 'baud': 9600}}


def test_custom_messages_alone_are_enough_to_find_a_board(board, tmp_path):
    config = tmp_path / 'base.yaml'
    config.write_text('arduino: {messages: {force: {type: 32, ros_type: std_msgs/Float32, '
                      'layout: "<h", fields: [data]}}}')
    path = board('port', arduino.encode_raw(32, b'\1\2')).path
    assert 'sends only custom messages' in run(path).stdout
    assert 'arduino' in to_paste(run('--config', config, path).stdout)


_READER = '''
import sys, serial
port = serial.Serial(sys.argv[1], 115200)
while True:
    sys.stdout.buffer.write(port.read(16))
    sys.stdout.flush()
'''


def test_a_port_that_another_program_has_open_is_named_and_not_touched(board, tmp_path):
    """The reader does not lock the port, so it would lose bytes to a second one."""
    port = board('port', MCU)
    script = tmp_path / 'serial_monitor'
    script.write_text(_READER)
    with subprocess.Popen([sys.executable, str(script), port.path],
                          stdout=subprocess.PIPE) as reader:
        try:
            data = reader.stdout.read(16)
            assert holders_of(port.path) == [Holder(reader.pid, 'serial_monitor')]
            done = run(port.path)
            assert f'open in  serial_monitor (pid {reader.pid})' in done.stdout
            assert 'not listened to: another program has it open' in done.stdout
            assert found(port.path)['port']['held_by'] == f'serial_monitor (pid {reader.pid})'
            decoder = mcu.Decoder()
            frames = decoder.feed(data + reader.stdout.read(1600))
            assert sum(decoder.errors.values()) <= 1 and len(frames) > 90    # 1: the first bytes
        finally:
            reader.kill()
    assert holders_of(port.path) == []


# -- its parts, without a port ------------------------------------------------------------------


BOARDS = {name: Candidate(description(name), {}) for name in ('bus', 'arduino', 'mcu')}


@pytest.mark.parametrize('mode, group, words', [
    (0o660, 'dialout', 'join the group that owns it: sudo usermod -a -G dialout $USER'),
    (0o660, 'uucp', 'join the group that owns it: sudo usermod -a -G uucp $USER'),
    (0o600, 'dialout', 'only root may open it'), (0o660, 'root', 'only root may open it')])
def test_a_port_that_this_user_may_not_open_has_its_remedy(board, mode, group, words):
    target, is_root = os.path.realpath(board('port').path), os.geteuid() == 0
    assert advice.of_port(target) == []
    if is_root:
        shutil.chown(target, 'root', group)
    else:
        mode, words = 0, f'only {getpass.getuser()} may open it'
    os.chmod(target, mode)
    groups = os.getgroups()
    if is_root:
        os.setgroups([])    # after a login root is a member of its own group
        os.setegid(65534)
        os.seteuid(65534)
    try:
        remedy, = advice.of_port(target)
    finally:
        if is_root:
            os.seteuid(0)
            os.setegid(0)
            os.setgroups(groups)
    assert words in remedy


@pytest.mark.parametrize('options, words', [([], 'This computer has no serial port.'),
                                            (['--json'], '[]\n')])
def test_a_computer_without_a_serial_port_is_no_error(monkeypatch, capsys, options, words):
    monkeypatch.setattr(cli.devices, 'devices', lambda: [])
    assert cli.main(options) == 0
    assert capsys.readouterr().out.startswith(words)


@pytest.mark.parametrize('arguments, words', [
    (['--seconds', '0', 'x'], '0 s is out of range (above 0, at most 120)'),
    (['socket://x'], 'socket://x: socket:// takes a host, a port'),
    (['--config', '/no/such/file', 'x'], '/no/such/file: No such file or directory'),
])
def test_wrong_arguments_are_refused(arguments, words):
    done = run(*arguments)
    assert (done.returncode, done.stdout) == (2, '') and words in done.stderr
