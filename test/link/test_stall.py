"""The backlog of a stall is dropped: on a real tty, a chain of two, and sockets. The campaign
suspends the whole bridge."""
import contextlib
import os
import socket
import threading
import time
from functools import partial

import pytest
from fake_boards import PATIENCE, BusBoard, until
from lines import Line
from waiting import Waiter

from serial_communication.boards.arduino.link import ArduinoLink, ArduinoSettings
from serial_communication.link.connection import PortState
from serial_communication.link.outcome import NOT_SENT
from serial_communication.link.stall import AFTER_STALL, STALL, StallWatch
from serial_communication.boards.bus.link import BusLink, BusSettings
from serial_communication.boards.mcu.link import McuLink
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.bus import wire as bus
from serial_communication.transport import pace
from serial_communication.transport.port import Port

pytestmark = [pytest.mark.slow, pytest.mark.stalls]


def status(number):
    """A frame with this number, and a SEQ of its last eight bits."""
    return mcu.encode(mcu.AdcStatus(number % 65536, number // 65536, 0, 0, 0, 0), number % 256)


@pytest.fixture
def server():
    with socket.socket() as listening:
        listening.bind(('127.0.0.1', 0))
        listening.listen(1)
        listening.settimeout(PATIENCE)
        yield listening


# -- one link, whose clock jumps ------------------------------------------------------------------

def is_dropping(link):
    return link.connection.state is PortState.DROPPING


class Clock:
    """Replaces the clock of the links. Once a test has let it jump, it stands.

    So no stall of this machine counts.
    """

    def __init__(self):
        self._real = pace.clock
        self._stopped_at = None

    def __call__(self):
        return self._real() if self._stopped_at is None else self._stopped_at

    @property
    def stands(self):
        return self._stopped_at is not None

    def jump(self, seconds=0.0):
        """Let so much time pass at once; a link that sleeps does not wake."""
        self._stopped_at = self() + seconds

    def begin_stall(self, link, seconds):
        """Let the link's thread wake from a stall; it drops what it reads until `end`."""
        self.jump(seconds)
        link.wake()
        until(lambda: is_dropping(link))

    def pass_time(self, link, seconds):
        """Let time pass while the clock stands; return when the link's thread has run."""
        self.jump(seconds)
        self.wait_for(link)

    def wait_for(self, link):
        until(lambda: link.connection.stalls.awake_at == self._stopped_at)

    def pass_until(self, link, condition):
        """Let time pass in steps that are no stalls, until `condition()`."""
        until(condition, doing=lambda: self.pass_time(link, STALL / 2))

    def end(self, link):
        """Let time pass until nothing is dropped."""
        self.pass_until(link, lambda: not is_dropping(link))


@pytest.fixture
def clock(monkeypatch):
    made = Clock()
    monkeypatch.setattr(pace, 'clock', made)
    return made


@pytest.fixture
def send(line, sensor):
    """A function: send a status until it is passed on."""
    return lambda seq: until(lambda: sensor.got[-1:] == [seq] or line.write(status(seq)))


def test_a_stall_on_an_idle_line_is_not_logged(sensor, lines, clock):
    for _ in range(2):
        clock.begin_stall(sensor, 100.0)
        clock.end(sensor)
    assert dict(sensor.report(time.monotonic()).values)['stale'] == 0
    assert not lines('stalled')


def test_stale_bytes_are_counted_and_their_frames_count_as_lost(line, sensor, send, lines, clock):
    send(1)
    clock.begin_stall(sensor, 2.0)
    before = sensor.connection.stale     # more than one copy of the first may have been written
    old = b'noise'.join(map(status, range(2, 9)))
    line.write(old)
    until(lambda: sensor.connection.stale == before + len(old))
    clock.end(sensor)
    line.write(status(9))
    until(lambda: sensor.got[-1] == 9)
    assert set(sensor.got) == {1, 9}
    values = dict(sensor.report(time.monotonic()).values)
    assert values['stale'] == before + len(old) and values['frames lost'] == 7
    assert values['checksum errors'] == values['framing errors'] == 0
    assert len(lines('stalled for 2')) == 1


def test_the_rest_of_a_packet_that_began_in_the_backlog_is_not_received(line, open_link, clock):
    """Without a checksum the end of a long packet can look like a valid short one."""
    got = []
    link = open_link(ArduinoLink, frame_timeout=5.0,
                     on_message=lambda message, stamp: got.append(message))
    clock.begin_stall(link, 2.0)
    line.write(b'\x20\x09')
    until(lambda: link.connection.stale == 2)
    clock.end(link)
    line.write(arduino.encode(arduino.Ticks(77)) + arduino.encode(arduino.Ticks(5)))
    until(lambda: got)
    assert got == [arduino.Ticks(5)]


def test_an_old_frame_inside_a_false_one_is_not_received_when_that_is_given_up(
        line, open_link, clock):
    """It is found after the stall, but waited during it."""
    got = []
    link = open_link(McuLink, timeout=60.0, frame_timeout=60.0,
                     on_status=lambda message, seq, stamp: got.append(seq))
    clock.begin_stall(link, 2.0)
    old = b'\x02\x40' + status(2)     # it would be 67 bytes long
    line.write(old)
    until(lambda: link.connection.stale == len(old))
    clock.end(link)
    until(lambda: got or line.write(status(3)))
    assert set(got) == {3}


def test_the_hook_stalled_is_called_before_a_frame_is_received(sensor, send, clock, monkeypatch):
    monkeypatch.setattr(sensor, 'stalled', lambda seconds, now: sensor.got.append(seconds))
    send(1)
    clock.begin_stall(sensor, 40.0)
    assert sensor.got[-1] == pytest.approx(40.0, abs=5.0)
    clock.end(sensor)
    send(2)


@pytest.mark.parametrize('kind, openings', [
    (partial(ArduinoLink, settings=ArduinoSettings(network_silence=0.0)), 2),
    (partial(McuLink, network_silence=0.0), 2), (BusLink, 1)], ids=('arduino', 'mcu', 'bus'))
def test_a_network_port_is_opened_anew_after_a_stall_unless_the_link_has_fences(
        kind, openings, server, logger, running, clock):
    clock.jump()
    link = running(kind(Port('socket://127.0.0.1:%d' % server.getsockname()[1]), logger=logger))
    peers = [server.accept()[0]]
    until(lambda: link.connection.number == 1)
    clock.begin_stall(link, 2.0)
    clock.end(link)
    if openings == 2:
        peers.append(server.accept()[0])
        until(lambda: link.connection.number == 2)
    time.sleep(0.3)
    assert link.connection.number == openings and link.port.is_open
    for peer in peers:
        peer.close()


@pytest.fixture
def held(request, line, tmp_path, running, logger):
    """A link that hangs while it passes on the first number, until `free` is set.

    Its line is a tty, or, with the parameter 'chain', two that a program connects; `fd` is the
    board's end.
    """
    path, fd, got, entered, free = line.path, line.fd, [], threading.Event(), threading.Event()
    if getattr(request, 'param', '') == 'chain':
        chain = Line(tmp_path / 'near').plug()
        request.addfinalizer(chain.unplug)
        path, fd = chain.near, os.open(chain.far, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        request.addfinalizer(lambda: os.close(fd))

    def on_status(message, seq, stamp):
        got.append(message.adc0 + 65536 * message.adc1)
        entered.set()
        free.wait(PATIENCE)

    link = running(McuLink(Port(path), timeout=60.0, logger=logger, on_status=on_status))
    link.free, link.got, link.fd = free, got, fd
    until(lambda: link.connection.number)
    until(lambda: os.write(fd, status(1)) and entered.wait(1.0))
    return link


@pytest.mark.parametrize('held', ['tty', 'chain'], indirect=True)
def test_what_fills_the_line_while_a_callback_hangs_is_dropped(held, lines):
    """It would get a stamp that is too late. The line gives it out in many reads."""
    number, rest = 1, b''

    def send():
        nonlocal number, rest
        if not rest:
            number += 1
            rest = status(number)
        try:
            rest = rest[os.write(held.fd, rest):]
            return True
        except BlockingIOError:
            return False

    full_at = time.monotonic() + STALL + 0.5
    until(lambda: not send() and time.monotonic() > full_at, every=0.0)
    last = number       # sent in part
    held.free.set()
    until(lambda: send() and held.got[-1] > last, every=0.005)
    assert not set(held.got) & set(range(2, last + 1))
    assert held.got == sorted(set(held.got)) and held.connection.stale > 4000
    assert len(lines('are old and were dropped')) == 1


def test_tick_is_called_and_stop_works_while_a_backlog_without_end_is_dropped(line, logger, clock):
    silences, ended = [], threading.Event()

    def send():
        while not ended.is_set():
            with contextlib.suppress(BlockingIOError):
                os.write(line.fd, status(1))

    link = McuLink(Port(line.path), timeout=0.1, logger=logger,
                   on_silence=lambda *status: silences.append(status))
    link.start()
    board = Waiter(send)
    until(lambda: link.frames_received)
    clock.begin_stall(link, 5.0)
    del silences[:]
    until(lambda: silences)
    assert is_dropping(link)
    link.stop()
    link.join(PATIENCE)
    assert not link.port.is_open
    ended.set()
    board.result()


@pytest.fixture
def bus_link(line, open_link, running):
    """A link to a bus board, in step; `board` is the board."""
    link = open_link(BusLink, BusSettings(environment_period=0.0, reply_timeout=5.0,
                                          motion_timeout=PATIENCE))
    link.board = running(BusBoard(line))
    until(lambda: link.master.in_step)
    return link


def test_no_request_is_sent_while_replies_are_dropped(bus_link, clock):
    board = bus_link.board
    for readings in range(3):
        clock.begin_stall(bus_link, 1.0)
        seen = len(board.frames)
        caller = Waiter(bus_link.environment)
        time.sleep(0.2)
        assert len(board.frames) == seen
        clock.end(bus_link)
        assert caller.result()[0].success and len(board.executed) == readings + 1
    assert bus_link.master.timeouts == 0, 'the reply to an ECHO was dropped'


def test_a_stop_is_sent_while_replies_are_dropped(bus_link, clock):
    clock.begin_stall(bus_link, 1.0)
    stop = bus.Request(bus.FUNCTION, 0x2F)
    function = bus.Function('stop', 0x2F, repeatable=True, interrupts=True)
    caller = Waiter(lambda: bus_link.request(stop, function))
    until(lambda: stop in bus_link.board.requests())
    assert is_dropping(bus_link)
    clock.end(bus_link)
    assert caller.result().success


# -- what was asked for during a stall -------------------------------------------------------------

def test_a_stall_is_found_before_and_after_the_links_thread_runs_again(held, clock):
    connection = held.connection
    clock.jump()
    clock.jump(connection.stalls.awake_at + STALL - 0.01 - clock())
    assert not connection.may_be_from_a_stall()
    clock.jump(0.02)
    assert connection.may_be_from_a_stall(), 'before its thread runs'
    held.free.set()
    clock.wait_for(held)
    clock.pass_time(held, AFTER_STALL / 2)
    assert connection.may_be_from_a_stall(), 'after its thread has run'
    for _ in range(2):      # in two steps: neither is a stall
        clock.pass_time(held, AFTER_STALL / 3)
    assert not connection.may_be_from_a_stall()


def test_a_stall_counts_although_the_port_was_closed_or_is_lost_at_its_end(line, sensor, clock):
    """A USB adapter is often gone after the computer was suspended, and back at once."""
    connection = sensor.connection
    clock.jump(15.0)
    line.unplug()
    until(lambda: not sensor.port.is_open)
    clock.wait_for(sensor)
    assert connection.may_be_from_a_stall()
    while connection.may_be_from_a_stall():
        clock.pass_time(sensor, STALL / 2)
    clock.jump(15.0)
    line.plug()
    until(lambda: sensor.port.is_open)
    clock.wait_for(sensor)
    assert connection.may_be_from_a_stall()


def test_a_stall_while_the_port_is_just_being_opened_counts(line, logger, running, clock):
    is_open, goes_on = threading.Event(), threading.Event()

    class Opening(Port):
        def open(self):
            super().open()
            is_open.set()
            goes_on.wait(PATIENCE)
    got = []
    link = running(McuLink(Opening(line.path), timeout=60.0, logger=logger,
                           on_status=lambda message, seq, stamp: got.append(seq)))
    assert is_open.wait(PATIENCE)
    line.write(status(1))
    clock.jump(3.0)
    clock.wait_for(link)
    goes_on.set()
    until(lambda: link.connection.stale == len(status(1)))
    clock.end(link)
    line.write(status(2))
    until(lambda: got)
    assert got == [2]


def test_a_move_is_not_sent_if_the_bridge_stalls_just_before_its_request_is_written(
        bus_link, clock, monkeypatch):
    def encode(request, *arguments, whole=bus.encode_request):
        if request.cmd2 == bus.LIFT and not clock.stands:
            clock.jump(15.0)
        return whole(request, *arguments)

    monkeypatch.setattr(bus, 'encode_request', encode)
    outcome = bus_link.lift(0, 1)
    assert outcome.message == 'it may have waited while the bridge stalled; nothing was sent'
    clock.end(bus_link)
    assert bus_link.environment()[0].success and len(bus_link.board.executed) == 1


def test_what_moves_is_not_sent_if_it_was_asked_for_during_a_stall_or_just_after(bus_link, clock):
    link, board = bus_link, bus_link.board
    moves = [lambda: link.lift(0, 1), lambda: link.gimbal(0, 1),
             lambda: link.request(bus.Request(bus.FUNCTION, 0x30))]
    clock.begin_stall(link, 15.0)
    for move in moves:
        outcome = move()
        assert outcome.status == NOT_SENT and not board.executed
        assert outcome.message == 'it may have waited while the bridge stalled; nothing was sent'
    clock.end(link)
    assert link.environment()[0].success and link.call(bus.SYNC_FUNCTION, ()).success
    assert link.call(bus.ECHO_FUNCTION, (b'mine',)).success
    clock.pass_until(link, lambda: not link.connection.may_be_from_a_stall())
    for move in moves:
        assert move().success
    assert len(board.moves()) == 3


def test_a_move_that_waited_for_its_turn_during_a_stall_is_not_sent(bus_link, clock, monkeypatch):
    link, board = bus_link, bus_link.board
    submitted, submit = [], link.master.submit
    monkeypatch.setattr(link.master, 'submit', lambda call: submitted.append(submit(call)))
    board.script.append(b'')
    moving = Waiter(link.lift, 0, 1)
    until(lambda: board.moves() == [bus.lift(0, 1)])
    waiting = [Waiter(link.gimbal, 0, 1), Waiter(link.environment)]
    until(lambda: len(submitted) == 3)
    for _ in range(2):      # the link's thread takes them in between
        until(lambda at=link.connection.stalls.awake_at: link.connection.stalls.awake_at > at)
    clock.begin_stall(link, 15.0)
    clock.end(link)
    assert 'waited while the bridge stalled' in waiting[0].result().message
    board.say(bus.Reply(bus.OK))
    assert moving.result().success and waiting[1].result()[0].success
    assert board.moves() == [bus.lift(0, 1)]


def test_a_watch_finds_the_stall_of_the_thread_that_stalled_longest():
    watch = StallWatch(0.5, 10.0)
    assert watch.stalled_for(10.5) == 0.0 and not watch.has_just_stalled(10.5)
    assert watch.stalled_for(10.5, receiving_at=9.0) == 1.5
    assert watch.has_just_stalled(10.99) and not watch.has_just_stalled(11.0)
    assert watch.stalled_for(12.0) == 2.0
    assert watch.stalled_for(11.0) == 1.0, 'by a thread that has read the clock earlier'
    assert watch.has_just_stalled(12.49)
    assert StallWatch(0.5).stalled_for(1e9) == 0.0, 'its thread was not started'
