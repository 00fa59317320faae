"""wire listen on real ttys, and the option --config."""
import os
import re
import signal
import subprocess
import sys
from functools import partial

import pytest
from lines import ROOT, Pty
from programs import started
from waiting import PATIENCE, until

from serial_communication.boards.mcu import wire as mcu

pytestmark = pytest.mark.slow
PROGRAM = [sys.executable, ROOT + '/scripts/wire']


class Listen:
    """A running `wire listen`, with its output in files."""

    def __init__(self, folder, link, port):
        self.paths = [folder / 'stdout', folder / 'stderr']
        with open(self.paths[0], 'w') as output, open(self.paths[1], 'w') as errors:
            self.process = subprocess.Popen([*PROGRAM, 'listen', link, str(port)],
                                            stdout=output, stderr=errors)

    def until_said(self, words, count=1):
        until(lambda: self.paths[1].read_text().count(words) >= count, words)

    def shown(self, board, data, count):
        """Write data to a port; return the lines of the program when there are so many."""
        board.write(data)
        return until(lambda: [self.paths[0].read_text().splitlines()] if self.paths[
            0].read_text().count('\n') == count else None, f'{count} lines')[0]

    def end(self, number=signal.SIGINT):
        self.process.send_signal(number)
        return self.process.wait(PATIENCE)


@pytest.fixture
def start(tmp_path):
    yield from started(partial(Listen, tmp_path))


@pytest.fixture
def board(tmp_path):
    one = Pty(tmp_path / 'board').plug()
    yield one
    one.unplug()


def status(number):
    return mcu.encode(mcu.SensorStatus(number, 500, 30.0, 4.0, 5.0), number % 256)


def test_listen_shows_every_frame_and_writes_nothing(board, start):
    program = start('mcu', board.path)
    program.until_said('open')
    lines = program.shown(board, status(1) + b'\x11\x22' + status(2) + status(3)[:7], 4)
    found = [re.fullmatch(r'\d\d:\d\d:\d\d\.\d{6} +(\+\S+ ms)? +((?:[0-9a-f]{2} )+) +(.*)', line)
             for line in lines]
    assert [bytes.fromhex(each.group(2)) for each in found] == [
        status(1), b'\x11\x22', status(2), status(3)[:7]]
    assert [each.group(1) is None for each in found] == [True, False, False, False]
    assert [each.group(3).startswith('framing: ') for each in found] == [False, True, False, True]
    assert found[0].group(3).startswith('sensor status')
    assert board.read() == b''
    assert program.end() == 0
    program.until_said('4 frames, 2 of them invalid')


def test_listen_waits_for_a_port_and_opens_it_again(tmp_path, start):
    board = Pty(tmp_path / 'late')
    program = start('mcu', board.path)
    program.until_said('waiting for it')
    for count in (1, 2):
        board.plug()
        program.until_said('late: open', count)
        program.shown(board, status(count), count)
        board.unplug()
        program.until_said('the device has gone', count)
    assert program.end(signal.SIGTERM) == 0


def run(*arguments):
    return subprocess.run([*PROGRAM, *map(str, arguments)], timeout=PATIENCE, text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE)


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
