"""The program `simulator` as users and roslaunch start it."""
import os
import pty
import signal
import subprocess
import sys
from functools import partial

import pytest
from lines import ROOT
from programs import started
from waiting import PATIENCE, until

from serial_communication.boards.bus import wire as bus

SIMULATOR = os.path.join(ROOT, 'scripts', 'simulator')


def run(*arguments, **options):
    return subprocess.run([sys.executable, SIMULATOR] + list(arguments), timeout=PATIENCE,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)


class Running:
    """A running simulator, which prints to a file."""

    def __init__(self, directory, *arguments):
        self._output = directory / 'output'
        with open(self._output, 'w') as output:
            self.process = subprocess.Popen([sys.executable, SIMULATOR] + list(arguments),
                                            stdout=output, stderr=subprocess.STDOUT,
                                            cwd=str(directory))

    def text(self):
        return self._output.read_text()

    def end(self, number=signal.SIGTERM):
        self.process.send_signal(number)
        return self.process.wait(PATIENCE)


@pytest.fixture
def start(tmp_path):
    yield from started(partial(Running, tmp_path))


@pytest.fixture
def tty():
    """The path of a tty for the board, and the file descriptor of its other end."""
    near, far = pty.openpty()
    yield os.ttyname(far), near
    os.close(near)
    os.close(far)


@pytest.mark.parametrize('arguments, says', [
    ([], 'BOARD'), (['toaster'], 'no board toaster'), (['json'], "no attribute 'DESCRIPTION'"),
    (['bus', '--port', 'x', '--link', 'y'], 'not allowed'), (['bus', '--port', ''], 'is empty'),
    (['mcu', '--port', 'x', '--faults', 'flip=0.1 flap=1'], 'flap'),
    (['bus', '--port', 'x', '--lift-speed', '0'], 'lift-speed'),
    (['mcu', '--port', 'x', '--rate', 'fast'], 'rate'),
    (['mcu', '--port', 'x', '--stall', '1'], 'stall'),
    (['bus', '--port', 'nonsense://x'], 'nonsense')])
def test_wrong_arguments_end_it_with_status_2_and_the_reason(arguments, says):
    result = run(*arguments)
    assert result.returncode == 2
    assert says in result.stderr.splitlines()[-1] and 'Traceback' not in result.stderr


@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_a_working_simulator_cleanly(start, tty, number):
    simulator = start('arduino', '--port', tty[0], '--faults', 'all', '--seed', '3',
                      '__name:=car', '__log:=/tmp/x.log', 'a:=b')
    until(lambda: 'open' in simulator.text(), 'the port')
    assert os.read(tty[1], 1000)
    assert simulator.end(number) == 0
    said = simulator.text()
    assert 'seed 3, faults all' in said and 'frames; faults:' in said and 'Traceback' not in said


def test_it_waits_for_an_absent_port(start, tty, tmp_path):
    name = tmp_path / 'port'
    simulator = start('bus', '--port', str(name))
    until(lambda: 'waiting' in simulator.text(), 'the waiting')
    name.symlink_to(tty[0])
    until(lambda: 'open' in simulator.text(), 'the port')
    port_answers(tty[1])
    assert simulator.end() == 0
    assert len(simulator.text().splitlines()) == 3      # waiting, open, synchronised


def port_answers(descriptor):
    os.write(descriptor, bus.encode_request(bus.SYNC_REQUEST))
    answer = b''
    while len(answer) < 4:
        answer += os.read(descriptor, 100)
    assert answer == bus.encode_reply(bus.Reply(bus.SYNC))
