"""wire listen on real ttys, and the option --config."""
import os
import re
import signal
import subprocess
import sys
from functools import partial

import pytest
from lines import ROOT, Pty
from programs import Process, started
from waiting import PATIENCE, until

from serial_communication.boards.mcu import wire as mcu

pytestmark = pytest.mark.slow
PROGRAM = [sys.executable, ROOT + '/scripts/wire']


@pytest.fixture
def start():
    yield from started(partial(Process, *PROGRAM, 'listen', 'mcu'))


def shown(program, board, data, count):
    """Write data to a port; return the lines of frames when there are so many."""
    board.write(data)

    def lines():
        return [line for line in program.output().splitlines() if re.match(r'\d\d:', line)]
    until(lambda: len(lines()) == count, f'{count} lines')
    return lines()


@pytest.fixture
def board(tmp_path):
    one = Pty(tmp_path / 'board').plug()
    yield one
    one.unplug()


def status(number):
    return mcu.encode(mcu.SensorStatus(number, 500, 30.0, 4.0, 5.0), number % 256)


def test_listen_shows_every_frame_and_writes_nothing(board, start):
    program = start(board.path)
    program.wait_for('open')
    lines = shown(program, board, status(1) + b'\x11\x22' + status(2) + status(3)[:7], 4)
    found = [re.fullmatch(r'\d\d:\d\d:\d\d\.\d{6} +(\+\S+ ms)? +((?:[0-9a-f]{2} )+) +(.*)', line)
             for line in lines]
    assert [bytes.fromhex(each.group(2)) for each in found] == [
        status(1), b'\x11\x22', status(2), status(3)[:7]]
    assert [each.group(1) is None for each in found] == [True, False, False, False]
    assert [each.group(3).startswith('framing: ') for each in found] == [False, True, False, True]
    assert found[0].group(3).startswith('sensor status')
    assert board.read() == b''
    assert program.end() == 0
    program.wait_for('4 frames, 2 of them invalid')


def test_listen_waits_for_a_port_and_opens_it_again(tmp_path, start):
    board = Pty(tmp_path / 'late')
    program = start(board.path)
    program.wait_for('waiting for it')
    for count in (1, 2):
        board.plug()
        until(lambda: program.output().count('late: open') == count, 'open')
        shown(program, board, status(count), count)
        board.unplug()
        until(lambda: program.output().count('the device has gone') == count, 'gone')
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
