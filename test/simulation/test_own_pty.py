"""Simulated boards on a pseudo terminal of their own: what a bridge that opens it finds."""
import contextlib
import os
import signal
import subprocess
import sys
import threading

import pytest
from lines import ROOT
from simulation_bench import Notes
from waiting import PATIENCE, until

from serial_communication.boards.bus import wire as bus
from serial_communication.boards.bus.link import BusLink
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
    """Context in which the board runs on a pseudo terminal of its own; yields its journal."""
    notes, port = Notes(), OwnPty(link)
    runner = Runner(board, port, journal=notes)
    thread = threading.Thread(target=runner.run, name='board')
    thread.start()
    try:
        yield notes
    finally:
        runner.stop()
        thread.join(PATIENCE)
        port.remove()
        assert not thread.is_alive() and not os.path.exists(os.path.dirname(link))


def of(notes, **fields):
    """The frames in the journal with these fields."""
    return [each for each in notes.of('tx') if fields.items() <= each.items()]


def assert_nothing_old_is_read(link, notes):
    """Open it; return its descriptor after the first frame, which was written since then."""
    before = notes.of('tx')[-1]['n'] if notes.of('tx') else 0
    bridge = os.open(link, os.O_RDWR | os.O_NOCTTY)
    decoder = mcu.Decoder()
    frames = []
    while not frames:
        frames = decoder.feed(os.read(bridge, 1))
    raw = frames[0].raw.hex()
    sent, = until(lambda: of(notes, raw=raw), 'the board notes a frame after it is written')
    assert sent['n'] > before and 'why' not in sent
    return bridge


def test_a_board_goes_on_while_nobody_has_it_open_and_leaves_nothing_old(link):
    with running(SensorBoard(rate=50), link) as notes:
        for _ in range(2):
            bridge = assert_nothing_old_is_read(link, notes)
            frames = len(notes.of('tx'))
            until(lambda: len(notes.of('tx')) > frames + 5, 'frames that nobody reads')
            os.close(bridge)
            frames = len(of(notes, why='closed'))
            until(lambda: len(of(notes, why='closed')) > frames + 5, 'the board goes on')


def test_a_port_that_nobody_reads_loses_frames_and_keeps_none_for_the_next_program(link):
    with running(SensorBoard(rate=1000), link) as notes:
        bridge = assert_nothing_old_is_read(link, notes)
        until(lambda: of(notes, why='busy'), 'the port is full')
        os.close(bridge)
        until(lambda: of(notes, why='closed'), 'it is closed')
        os.close(assert_nothing_old_is_read(link, notes))


def test_a_link_of_the_bridge_opens_it_again_and_again(link):
    with running(ControlBoard(lift_speed=2000), link):
        for distance in 10, 20:
            bridge = BusLink(Port(link))
            bridge.start()
            until(lambda: bridge.session.master.in_step, 'SYNC')
            assert bridge.lift(0, distance).success
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
