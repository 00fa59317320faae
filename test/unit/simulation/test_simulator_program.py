"""The program `simulator`, on a given port and on a pseudo terminal of its own."""
import contextlib
import os
import pty
import signal
import sys
import threading
from functools import partial

import pytest
from lines import ROOT
from programs import Process, started
from waiting import PATIENCE, until

from serial_communication.boards.bus import wire as bus
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.mcu.simulator import SensorBoard
from serial_communication.simulation.board import Runner
from serial_communication.simulation.own_pty import OwnPty

SIMULATOR = [sys.executable, os.path.join(ROOT, 'scripts', 'simulator')]


@pytest.fixture
def start():
    yield from started(partial(Process, *SIMULATOR))


@pytest.fixture
def tty():
    """The path of a tty for the board, and the file descriptor of its other end."""
    near, far = pty.openpty()
    yield os.ttyname(far), near
    os.close(near)
    os.close(far)


def assert_answers(descriptor):
    """The bus board at this end answers SYNC."""
    os.write(descriptor, bus.encode_request(bus.SYNC_REQUEST))
    answer = b''
    while len(answer) < 4:
        answer += os.read(descriptor, 100)
    assert answer == bus.encode_reply(bus.Reply(bus.SYNC))


@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_a_working_simulator_cleanly(start, tty, number):
    simulator = start('arduino', '--port', tty[0], '--faults', 'all', '--seed', '3',
                      '__name:=car', '__log:=/tmp/x.log', 'a:=b')
    simulator.wait_for('open')
    assert os.read(tty[1], 1000)
    assert simulator.end(number) == 0
    said = simulator.output()
    assert 'seed 3, faults all' in said and 'frames; faults:' in said and 'Traceback' not in said


def test_it_waits_for_an_absent_port(start, tty, tmp_path):
    name = tmp_path / 'port'
    simulator = start('bus', '--port', str(name))
    simulator.wait_for('waiting')
    name.symlink_to(tty[0])
    simulator.wait_for(': open')
    assert_answers(tty[1])
    assert simulator.end(signal.SIGTERM) == 0


# -- on a pseudo terminal of its own ----------------------------------------------------------


def test_it_replaces_a_link_of_a_killed_one_and_removes_its_own(start, tmp_path):
    link = str(tmp_path / 'new' / 'folder' / 'board')
    for number, is_left in ((signal.SIGKILL, True), (signal.SIGTERM, False)):
        simulator = start('bus', '--link', link)
        simulator.wait_for('waiting for a program that opens it')
        if not is_left:
            with open(link, 'r+b', buffering=0) as port:
                assert_answers(port.fileno())
        simulator.end(number)
        assert os.path.islink(link) == is_left


def test_it_replaces_no_other_file(start, tmp_path):
    path = tmp_path / 'file'
    path.write_text('mine')
    simulator = start('bus', '--link', str(path))
    assert simulator.ended() == 1 and 'File exists' in simulator.output()
    assert path.read_text() == 'mine'


@contextlib.contextmanager
def running(board, link):
    """Context in which the board runs on a pseudo terminal of its own; yields its runner."""
    port = OwnPty(link)
    runner = Runner(board, port)
    thread = threading.Thread(target=runner.run, name='board')
    thread.start()
    try:
        yield runner
    finally:
        runner.stop()
        thread.join(PATIENCE)
        port.remove()
        assert not thread.is_alive() and not os.path.exists(link)


@pytest.mark.parametrize('rate, unread', [(50, 5), (1000, 700)], ids=['', 'the port is full'])
def test_a_board_goes_on_while_nobody_reads_it_and_leaves_nothing_old(tmp_path, rate, unread):
    link = str(tmp_path / 'board')
    with running(SensorBoard(rate=rate), link) as runner:
        line = runner.line
        for _ in range(2):
            before, decoder, frames = line.frames, mcu.Decoder(), []
            bridge = os.open(link, os.O_RDWR | os.O_NOCTTY)
            while not frames:
                frames = decoder.feed(os.read(bridge, 1))
            assert (frames[0].number - before) % 256 < 128      # SEQ counts every frame
            count = line.frames
            until(lambda: line.frames > count + unread, 'frames that nobody reads')
            os.close(bridge)
            until(lambda: not runner.port.is_open, 'it sees that it is closed')
            count = line.frames
            until(lambda: line.frames > count + 5, 'the board goes on')
