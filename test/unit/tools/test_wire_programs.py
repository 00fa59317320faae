"""wire listen on real ttys, boards of other packages, and what holds for every program of wire."""
import os
import re
import signal
import subprocess
import sys
from functools import partial

import pytest
from lines import Pty
from programs import started
from waiting import PATIENCE, until

from serial_communication.boards.mcu import wire as mcu
from wire_lines import ROOT

pytestmark = pytest.mark.slow
PROGRAM = [sys.executable, ROOT + '/scripts/wire']


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


@pytest.mark.parametrize('arguments', [
    [], ['dance'], ['listen'], ['listen', 'mcu'], ['listen', 'mcu', 'nonsense://x'], ['play', 'a'],
    ['play', 'a', 'mcu', 'b', '--rate', '2'], ['listen', 'mcu', '/dev/null', '--baud', '0'],
    ['tap', 'mcu', '/dev/null', '/dev/zero'], ['explain', 'mcu', '02', '--dance']], ids=' '.join)
def test_wrong_arguments_give_status_2(arguments):
    done = run(*arguments)
    assert done.returncode == 2 and 'Traceback' not in done.stderr
