"""Simulated boards on a pseudo terminal of their own: what a bridge that opens it finds."""
import contextlib
import os
import signal
import subprocess
import sys
import threading

import pytest
from lines import ROOT
from waiting import PATIENCE, until

from bus_moves import lift
from serial_communication.boards.bus import wire as bus
from links import BusLink
from serial_communication.boards.bus.simulator import ControlBoard
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.mcu.simulator import SensorBoard
from serial_communication.simulation.board import Runner
from serial_communication.simulation.own_pty import OwnPty
from serial_communication.transport.port import Port


@pytest.fixture
def link(tmp_path):
    return str(tmp_path / 'new' / 'folder' / 'board')


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
        assert not thread.is_alive() and not os.path.exists(os.path.dirname(link))


def assert_nothing_old_is_read(link, line):
    """Open it; return its descriptor after the first frame, which was written since then."""
    before = line.frames
    bridge = os.open(link, os.O_RDWR | os.O_NOCTTY)
    decoder = mcu.Decoder()
    frames = []
    while not frames:
        frames = decoder.feed(os.read(bridge, 1))
    assert (frames[0].number - before) % 256 < 128      # SEQ counts every frame
    return bridge


@pytest.mark.parametrize('rate, unread', [(50, 5), (1000, 700)], ids=['', 'the port is full'])
def test_a_board_goes_on_while_nobody_reads_it_and_leaves_nothing_old(link, rate, unread):
    with running(SensorBoard(rate=rate), link) as runner:
        line = runner.line
        for _ in range(2):
            bridge = assert_nothing_old_is_read(link, line)
            frames = line.frames
            until(lambda: line.frames > frames + unread, 'frames that nobody reads')
            os.close(bridge)
            until(lambda: not runner.port.is_open, 'it sees that it is closed')
            frames = line.frames
            until(lambda: line.frames > frames + 5, 'the board goes on')


def test_a_link_of_the_bridge_opens_it_again_and_again(link):
    with running(ControlBoard(lift_speed=2000), link):
        for distance in 10, 20:
            bridge = BusLink(Port(link))
            bridge.start()
            until(lambda: bridge.request(lift(0, distance)).success, 'SYNC, and a move')
            bridge.stop()
            bridge.join(PATIENCE)


class Simulator:
    """The program, on a link."""

    def __init__(self, link):
        self.process = subprocess.Popen(
            [sys.executable, os.path.join(ROOT, 'scripts', 'simulator'), 'bus', '--link', link],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        self.said = self.process.stdout.readline()

    def end(self, number):
        self.process.send_signal(number)
        self.process.communicate(timeout=PATIENCE)
        return self.process.returncode


def test_the_program_replaces_a_link_of_a_killed_one_and_removes_its_own(link):
    first = Simulator(link)
    assert first.said == f'bus: {link}: waiting for a program that opens it\n'
    assert first.end(signal.SIGKILL) and os.path.islink(link)
    second = Simulator(link)
    with open(link, 'r+b', buffering=0) as port:
        port.write(bus.encode_request(bus.SYNC_REQUEST))
        assert port.read(4) == bus.encode_reply(bus.Reply(bus.SYNC))
    assert second.end(signal.SIGTERM) == 0 and not os.path.lexists(link)


def test_the_program_replaces_no_other_file(tmp_path):
    path = tmp_path / 'file'
    path.write_text('mine')
    program = Simulator(str(path))
    assert program.process.wait(PATIENCE) == 1
    assert program.said == f'link {path}: File exists\n' and path.read_text() == 'mine'
    program.process.stdout.close()
