"""The backlog of a stall is dropped: over real ttys, chains of them and sockets, with links in
suspended processes, and with values that are running numbers."""
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from fake_boards import PATIENCE, BusBoard, until
from lines import Line, Rfc2217Server
from programs import started
from waiting import Waiter

from serial_communication.boards.arduino.link import ArduinoLink
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
PROGRAM = Path(__file__).with_name('one_link.py')


class OneLink:
    """A link in another process; see one_link.py."""

    def __init__(self, kind, url):
        self.values, self.log, self.stale = [], [], None
        self.process = subprocess.Popen(
            [sys.executable, str(PROGRAM), kind, url], stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, universal_newlines=True,
            env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)})
        self._reader = threading.Thread(target=self._read, name='output of a link', daemon=True)
        self._reader.start()

    def _read(self):
        for line in self.process.stdout:
            kind, _, text = line.rstrip('\n').partition(' ')
            if kind == 'value':
                self.values.append(int(text))
            elif kind == 'log':
                self.log.append(text)
            else:
                self.stale = int(text)

    def suspend(self):
        """Returns when all its threads have stopped."""
        self.process.send_signal(signal.SIGSTOP)
        os.waitpid(self.process.pid, os.WUNTRACED)

    def resume(self):
        self.process.send_signal(signal.SIGCONT)

    def end(self):
        """End it; return the number of bytes that it dropped."""
        self.resume()
        self.process.stdin.close()
        self.process.wait(PATIENCE)
        self._reader.join(PATIENCE)
        self.process.stdout.close()
        return self.stale


@pytest.fixture
def one_link():
    yield from started(OneLink)


def status(number):
    """A frame with this number, and a SEQ of its last eight bits."""
    return mcu.encode(mcu.AdcStatus(number % 65536, number // 65536, 0, 0, 0, 0), number % 256)


class Numbers:
    """A board that sends running numbers, one every `pause` s, to a non-blocking descriptor.

    `sent` is the latest number that was sent as a whole, `refused` counts the writes to a full
    buffer. `accept` returns a descriptor for the next connection when one has ended.
    """

    def __init__(self, accept, pause=0.005):
        self.sent = 0
        self.refused = 0
        self.pause = pause
        self._accept = accept
        self._fd = accept()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name='numbers', daemon=True)

    def start(self):
        self._thread.start()

    def stop(self):
        self._ending.set()
        self._thread.join(PATIENCE)

    def _run(self):
        rest = b''
        while not self._ending.is_set():
            rest = rest or status(self.sent + 1)
            try:
                rest = rest[os.write(self._fd, rest):]
            except BlockingIOError:
                self.refused += 1
                time.sleep(0.002)
                continue
            except ConnectionError:
                rest = b''
                self._fd = self._accept()
            if not rest:
                self.sent += 1
                if self.pause:
                    time.sleep(self.pause)


@pytest.fixture
def socat(tmp_path):
    """Two connected pseudo terminals: the path of the near one, the descriptor of the far one."""
    pair = Line(tmp_path / 'near').plug()
    fd = os.open(pair.far, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    yield pair.near, fd
    os.close(fd)
    pair.unplug()


@pytest.fixture
def server():
    with socket.socket() as listening:
        listening.bind(('127.0.0.1', 0))
        listening.listen(1)
        listening.settimeout(PATIENCE)
        yield listening


@pytest.fixture
def connection(request, line, server):
    """The URL for the link, and a function that returns the board's descriptor once it is open."""
    kind = request.param
    if kind == 'tty':
        yield line.path, lambda: line.fd
    elif kind == 'chain':
        near, fd = request.getfixturevalue('socat')
        yield near, lambda: fd
    elif kind == 'rfc2217':
        relay = Rfc2217Server(server, line.path, connections=2)
        yield relay.url, lambda: line.fd
        relay.end()
    else:
        peers = []

        def accept():
            peers.append(server.accept()[0])
            peers[-1].setblocking(False)
            return peers[-1].fileno()

        yield 'socket://127.0.0.1:%d' % server.getsockname()[1], accept
        for peer in peers:
            peer.close()


@pytest.mark.parametrize('connection, burst', [
    ('tty', False), ('chain', False), ('socket', False), ('rfc2217', False),
    ('tty', True), ('chain', True), ('socket', True)], indirect=['connection'],
    ids=lambda each: {False: 'at the rate of a line', True: 'as fast as possible'}.get(each, each))
def test_values_sent_while_the_bridge_was_suspended_are_not_published(
        connection, burst, one_link, running):
    url, fd = connection
    link = one_link('mcu', url)
    board = running(Numbers(fd))
    until(lambda: len(link.values) > 20)
    link.suspend()
    first = board.sent + 2      # the next one may be sent in part already
    began = time.monotonic()
    board.pause = 0.0 if burst else 0.005
    sent = 1200 if burst else 50
    until(lambda: time.monotonic() > began + 1.5
          and (board.sent > first + sent or board.refused))
    board.pause = 0.005
    last = board.sent
    link.resume()
    until(lambda: link.values[-1] > last)
    seen = len(link.values)
    until(lambda: len(link.values) > seen + 20)
    board.stop()
    stale = link.end()
    old = [value for value in link.values if first <= value <= last]
    assert not old, f'{len(old)} of the values {first} … {last}'
    assert link.values == sorted(set(link.values))
    assert len([text for text in link.log if 'are old and were dropped' in text]) == 1
    if '://' in url:
        assert stale and len([text for text in link.log if 'opening it again' in text]) == 1
    else:
        assert stale >= (last - first) * 10 if not burst else stale > 20000


def test_values_that_a_relay_sends_slowly_after_a_stall_are_not_published(server, one_link):
    """No faster than the line, as values that are new. But they come over the old connection."""
    link = one_link('mcu', 'socket://127.0.0.1:%d' % server.getsockname()[1])
    relays = [server.accept()[0]]
    number = 0

    def send_next():
        nonlocal number
        number += 1
        try:
            relays[-1].sendall(status(number))
        except ConnectionError:
            relays.append(server.accept()[0])

    until(lambda: send_next() or len(link.values) > 20, every=0.005)
    link.suspend()
    first, last = number + 1, number + 400
    time.sleep(1.0)
    link.resume()
    before = len(relays)
    while number < last and len(relays) == before:
        send_next()
        time.sleep(0.005)
    number = last
    until(lambda: send_next() or link.values[-1] > last, every=0.005)
    for relay in relays:
        relay.close()
    assert not set(range(first, last + 1)) & set(link.values)


def test_a_reply_that_waited_is_not_published_and_the_bus_is_out_of_step(
        line, one_link, running):
    link = one_link('bus', line.path)
    asked = []          # for each request for a reading, the other requests before it
    others = []
    wait_for = 10

    def answer(request):
        if request != bus.ENVIRONMENT_REQUEST:
            others.append(request)
            return None
        asked.append(list(others))
        del others[:]
        if len(asked) == wait_for:
            link.suspend()
        return bus.Reply(bus.OK, bus.Environment(len(asked), 20.0, 50.0).pack())

    running(BusBoard(line, rule=answer))
    until(lambda: len(asked) == wait_for)
    time.sleep(1.0)
    link.resume()
    until(lambda: link.values and link.values[-1] > wait_for)
    assert wait_for not in link.values
    assert bus.ECHO in [request.cmd1 for request in asked[wait_for]], 'no ECHO before the next'
    assert link.end() >= len(bus.encode_reply(bus.Reply(bus.OK, bytes(6))))
    assert any('out of step: the bridge stalled' in text for text in link.log)


# -- one link, whose clock jumps ------------------------------------------------------------------

def is_dropping(link):
    return link.connection.state is PortState.DROPPING


class Clock:
    """Replaces the clock of the links; it can jump and stop."""

    def __init__(self):
        self._real = pace.clock
        self._ahead = 0.0
        self._stopped_at = None

    def __call__(self):
        return self._real() + self._ahead if self._stopped_at is None else self._stopped_at

    def begin_stall(self, link, seconds):
        """Let the link's thread wake from a stall; it drops what it reads until `end`."""
        self._stopped_at = self() + seconds
        link.wake()
        until(lambda: is_dropping(link))

    def pass_time(self, link, seconds):
        """Let time pass while the clock stands; return when the link's thread has run."""
        self._stopped_at += seconds
        self.wait_for(link)

    def wait_for(self, link):
        until(lambda: link.connection.stalls.awake_at == self._stopped_at)

    def end(self, link):
        """Let time pass, in steps that are no stalls, until nothing is dropped."""
        while is_dropping(link):
            self.pass_time(link, STALL / 2)
        self._ahead = self._stopped_at - self._real()
        self._stopped_at = None
        until(lambda: not is_dropping(link))


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


@pytest.mark.parametrize('kind, openings', [(ArduinoLink, 2), (McuLink, 2), (BusLink, 1)])
def test_a_network_port_is_opened_anew_after_a_stall_unless_the_link_has_fences(
        kind, openings, server, logger, running, clock):
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
def held(line, open_link):
    """A link that hangs while it passes on the first status, until `free` is set."""
    entered, free, got = threading.Event(), threading.Event(), []

    def on_status(message, seq, stamp):
        got.append(seq)
        entered.set()
        free.wait(PATIENCE)

    link = open_link(McuLink, timeout=60.0, on_status=on_status)
    link.free, link.got = free, got
    until(lambda: entered.is_set() or line.write(status(1)))
    return link


def test_a_slow_callback_is_a_stall(line, held):
    """Frames that arrive meanwhile would get a stamp that is too late."""
    line.write(status(2))
    time.sleep(STALL + 0.1)
    held.free.set()
    until(lambda: held.connection.stale)
    until(lambda: 3 in held.got or line.write(status(3)))
    assert 2 not in held.got


def test_tick_is_called_and_stop_works_while_a_backlog_without_end_is_dropped(
        line, logger, clock):
    silences = []
    link = McuLink(Port(line.path), timeout=0.1, logger=logger,
                   on_silence=lambda *status: silences.append(status))
    link.start()
    board = Numbers(lambda: line.fd, 0.0)
    board.start()
    until(lambda: link.frames_received)
    clock.begin_stall(link, 5.0)
    del silences[:]
    until(lambda: silences)
    assert is_dropping(link)
    began = time.monotonic()
    link.stop()
    link.join()
    assert time.monotonic() - began < 1.0 and not link.port.is_open
    board.stop()


@pytest.fixture
def bus_link(line, open_link, running):
    """A link to a bus board, in step; `board` is the board."""
    link = open_link(BusLink, BusSettings(environment_period=0.0, motion_timeout=PATIENCE))
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
    clock._stopped_at = connection.stalls.awake_at + STALL - 0.01
    assert not connection.may_be_from_a_stall()
    clock._stopped_at = connection.stalls.awake_at + STALL + 0.01
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
    clock._stopped_at = clock() + 15.0
    line.unplug()
    until(lambda: not sensor.port.is_open)
    clock.wait_for(sensor)
    assert connection.may_be_from_a_stall()
    while connection.may_be_from_a_stall():
        clock.pass_time(sensor, STALL / 2)
    clock._stopped_at += 15.0
    line.plug()
    until(lambda: sensor.port.is_open)
    clock.wait_for(sensor)
    assert connection.may_be_from_a_stall()


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
    until(lambda: not link.connection.may_be_from_a_stall())
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
