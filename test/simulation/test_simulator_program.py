"""The program `simulator` as users and roslaunch start it, and the journal's file."""
import json
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
    ([], 'BOARD'), (['toaster'], 'no board toaster'), (['json'], 'has no DESCRIPTION'),
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


_BEACON = '''"""A board of another package: it says hello ten times a second."""
from serial_communication.simulation.board import Board, positive
from serial_communication.transport.pace import Every


class Beacon(Board):
    NAME = SUMMARY = 'beacon'
    FAULTS = 'drop=0.1'
    READS = False

    def __init__(self, rate):
        super().__init__()
        self.beat = Every(1 / rate, 0.0)

    @classmethod
    def add_options(cls, parser):
        parser.add_argument('--rate', type=positive, default=100.0, help='hellos a second')

    @classmethod
    def from_options(cls, options):
        return cls(options.rate)

    def advance(self, now):
        if self.beat.passed(now):
            self.send(b'hello ', None)
        return self.beat.due

    def fields(self, frame, message):
        return {}


BOARD = Beacon
'''


_DESCRIPTION = """\
from serial_communication.boards.description import Description
DESCRIPTION = Description('light', __name__, None)
"""


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """A folder on Python's path for the board of another package."""
    folder = tmp_path / 'elsewhere' / 'beacon'
    folder.mkdir(parents=True)
    (folder / '__init__.py').write_text(_DESCRIPTION)
    monkeypatch.setenv('PYTHONPATH', f'{folder.parent}:{os.environ.get("PYTHONPATH", "")}')
    return folder


def test_a_board_of_another_package_runs_and_has_its_help(elsewhere, start, tty):
    path, near = tty
    (elsewhere / 'simulator.py').write_text(_BEACON)
    # --config is accepted though not used, since a launch file passes it to all boards.
    start('beacon', '--port', path, '--rate', '200', '--fault', 'drop=0.2',
          '--config', os.path.join(ROOT, 'config', 'bridge.yaml'))
    received = b''
    while b'hello hello' not in received:
        received += os.read(near, 100)
    says = run('beacon', '--help').stdout
    assert 'hellos a second' in says and 'says hello ten times' in says and 'drop=0.1' in says
    assert 'stall' not in says      # a fault that a board that only sends cannot have


@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_a_working_simulator_cleanly(start, tty, tmp_path, number):
    simulator = start('arduino', '--port', tty[0], '--journal', 'journal', '--fault', 'all',
                      '--seed', '3', '__name:=car', '__log:=/tmp/x.log', 'a:=b')
    until(lambda: 'open' in simulator.text(), 'the port')
    assert os.read(tty[1], 1000)
    assert simulator.end(number) == 0
    assert 'seed 3' in simulator.text() and 'Traceback' not in simulator.text()
    lines = (tmp_path / 'journal').read_text().splitlines(True)
    assert all(line.endswith('\n') for line in lines)
    entries = [json.loads(line) for line in lines]
    assert entries[0]['ev'] == 'start' and entries[0]['board'] == 'arduino'
    assert entries[0]['seed'] == 3 and entries[0]['faults']['flip'] == '0.001'
    assert entries[-1]['ev'] == 'end' and entries[-1]['frames'] > 0
    assert all(isinstance(entry['t'], float) for entry in entries)


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


# -- the journal --------------------------------------------------------------------------------
