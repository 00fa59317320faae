"""What waited in a port while its link stalled is dropped: real ttys, chains of them and sockets,
links in processes that are suspended, and values that carry running numbers."""
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from fake_boards import PATIENCE, BusBoard, Rfc2217Server, until
from waiting import Waiter

from serial_communication.boards.arduino.link import ArduinoLink
from serial_communication.link.backlog import STALL, Backlog
from serial_communication.boards.bus.link import BusLink, BusSettings
from serial_communication.boards.mcu.link import McuLink
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.bus import wire as bus
from serial_communication.transport import pace
from serial_communication.transport.port import Port

pytestmark = pytest.mark.slow
PROGRAM = Path(__file__).with_name('one_link.py')


class OneLink:
    """A link in a process of its own."""

    def __init__(self, kind, url):
        self.values = []
        self.log = []
        self.stale = None
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
        """Returns when all its threads stand still."""
        self.process.send_signal(signal.SIGSTOP)
        tasks = Path(f'/proc/{self.process.pid}/task')
        until(lambda: all((task / 'stat').read_text().rpartition(')')[2].split()[0] == 'T'
                          for task in tasks.iterdir()))

    def resume(self):
        self.process.send_signal(signal.SIGCONT)

    def end(self):
        """End it; the bytes that it has dropped."""
        self.resume()
        self.process.stdin.close()
        self.process.wait(PATIENCE)
        self._reader.join(PATIENCE)
        self.process.stdout.close()
        return self.stale


@pytest.fixture
def one_link():
    begun = []

    def begin(*arguments):
        begun.append(OneLink(*arguments))
        return begun[-1]

    yield begin
    for link in begun:
        if link.process.poll() is None:
            link.process.kill()
            link.process.wait()
        link._reader.join(PATIENCE)


class Numbers:
    """A board that sends running numbers, as fast as `pause` says, to a non-blocking descriptor.

    What `sent` says has left the board completely.
    """

    def __init__(self, fd, pause=0.005):
        self.sent = 0
        self.pause = pause
        self._fd = fd
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
            number = self.sent + 1
            rest = rest or mcu.encode(
                mcu.AdcStatus(number % 65536, number // 65536, 0, 0, 0, 0), number % 256)
            try:
                rest = rest[os.write(self._fd, rest):]
            except BlockingIOError:
                time.sleep(0.002)
                continue
            if not rest:
                self.sent += 1
                if self.pause:
                    time.sleep(self.pause)


@pytest.fixture
def socat(tmp_path):
    """Two more pseudo terminals behind one another: the way from the board is longer."""
    near, far = str(tmp_path / 'near'), str(tmp_path / 'far')
    process = subprocess.Popen(['socat', f'pty,raw,echo=0,link={near}',
                                f'pty,raw,echo=0,link={far}'])
    until(lambda: os.path.exists(near) and os.path.exists(far))
    fd = os.open(far, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    yield near, fd
    os.close(fd)
    process.terminate()
    process.wait()


@pytest.fixture
def server():
    with socket.socket() as listening:
        listening.bind(('127.0.0.1', 0))
        listening.listen(1)
        listening.settimeout(PATIENCE)
        yield listening


@pytest.fixture
def way(request, line, server):
    """Where the link finds the board, and what gives the board's descriptor once it is open."""
    kind = request.param
    if kind == 'tty':
        yield line.path, lambda: line.fd
    elif kind == 'chain':
        near, fd = request.getfixturevalue('socat')
        yield near, lambda: fd
    elif kind == 'rfc2217':
        relay = Rfc2217Server(server, line.path)
        yield relay.url, lambda: line.fd
        relay.end()
    else:
        peers = []

        def accept():
            peers.append(server.accept()[0])
            peers[0].setblocking(False)
            return peers[0].fileno()

        yield 'socket://127.0.0.1:%d' % server.getsockname()[1], accept
        for peer in peers:
            peer.close()


@pytest.mark.parametrize('way, burst', [
    ('tty', False), ('chain', False), ('socket', False), ('rfc2217', False),
    ('tty', True), ('chain', True), ('socket', True)], indirect=['way'],
    ids=lambda each: {False: 'as a line', True: 'all that goes in'}.get(each, each))
def test_nothing_that_was_sent_while_the_bridge_was_suspended_is_published(
        way, burst, one_link, running):
    url, fd = way
    link = one_link('mcu', url)
    board = running(Numbers(fd()))
    until(lambda: len(link.values) > 20)
    link.suspend()
    first = board.sent + 2      # the one after that which may be half sent now
    began = time.monotonic()
    board.pause = 0.0 if burst else 0.005
    until(lambda: time.monotonic() > began + 1.5)
    board.pause = 0.005
    last = board.sent
    link.resume()
    assert last - first > 50
    until(lambda: link.values[-1] > last)
    seen = len(link.values)
    until(lambda: len(link.values) > seen + 20)
    board.stop()
    stale = link.end()
    old = [value for value in link.values if first <= value <= last]
    assert not old, f'{len(old)} of the values {first} … {last}'
    assert link.values == sorted(set(link.values))
    said = [text for text in link.log if 'stalled' in text]
    assert len(said) == 1 and 'bytes that waited in the port are old and were dropped' in said[0]
    assert stale >= (last - first) * 10 if not burst else stale > 20000


def test_a_reading_that_waited_is_not_published_and_the_bus_is_out_of_step(
        line, one_link, running):
    board = BusBoard(line)
    link = one_link('bus', line.path)
    asked = []          # the requests for a reading, each with what came before it
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

    board.rule = answer
    running(board)
    until(lambda: len(asked) == wait_for)
    suspended = time.monotonic()
    until(lambda: time.monotonic() > suspended + 1.0)
    link.resume()
    until(lambda: link.values and link.values[-1] > wait_for)
    assert wait_for not in link.values
    assert bus.ECHO in [request.cmd1 for request in asked[wait_for]], 'before it is asked again'
    assert link.end() >= len(bus.encode_reply(bus.Reply(bus.OK, bytes(6))))
    assert any('out of step: the bridge stalled' in text for text in link.log)


# -- one link, whose clock jumps ------------------------------------------------------------------

class Clock:
    """In the place of the links' clock: it can jump, and stand still."""

    def __init__(self):
        self._real = pace.clock
        self._ahead = 0.0
        self._stands_at = None

    def __call__(self):
        return self._real() + self._ahead if self._stands_at is None else self._stands_at

    def begin_stall(self, link, seconds):
        """The link's thread wakes from a stall, and drops what it reads until `end`."""
        self._stands_at = self() + seconds
        link.wake()
        until(lambda: link.drops)

    def end(self, link):
        self._ahead = self._stands_at - self._real()
        self._stands_at = None
        until(lambda: not link.drops)


@pytest.fixture
def clock(monkeypatch):
    made = Clock()
    monkeypatch.setattr(pace, 'clock', made)
    return made


def test_a_stall_on_an_idle_line_says_nothing(line, logger, running, lines, clock):
    link = running(McuLink(Port(line.path), timeout=60.0, logger=logger))
    until(lambda: link.port.is_open)
    for _ in range(2):
        clock.begin_stall(link, 100.0)
        clock.end(link)
    assert dict(link.report(time.monotonic()).values)['stale'] == 0
    assert not lines('stalled')


def test_stale_bytes_are_counted_and_their_frames_are_lost_ones_as_any_gap_in_seq(
        line, logger, running, lines, clock):
    got = []
    link = running(McuLink(Port(line.path), timeout=60.0, logger=logger,
                           on_status=lambda message, seq, stamp: got.append(seq)))
    frame = mcu.encode(mcu.AdcStatus(1, 2, 3, 4, 5, 6), 1)
    until(lambda: got or line.write(frame))
    clock.begin_stall(link, 2.0)
    before = link.stale     # of the frame that was written until one had come
    line.write(b''.join(mcu.encode(mcu.AdcStatus(1, 2, 3, 4, 5, 6), seq) for seq in range(2, 9)))
    until(lambda: link.stale == before + 7 * len(frame))
    clock.end(link)
    line.write(mcu.encode(mcu.AdcStatus(1, 2, 3, 4, 5, 6), 9))
    until(lambda: got[-1] == 9)
    assert set(got) == {1, 9}
    values = dict(link.report(time.monotonic()).values)
    assert values['stale'] == before + 7 * len(frame) and values['frames lost'] == 7
    assert values['checksum errors'] == values['framing errors'] == 0
    assert len(lines('stalled for 2')) == 1


def test_the_rest_of_a_packet_that_began_among_old_bytes_is_no_packet(
        line, logger, running, clock):
    """Without a checksum the tail of a long packet can be a valid short one."""
    got = []
    link = running(ArduinoLink(Port(line.path), logger=logger, frame_timeout=5.0,
                               on_message=lambda message, stamp: got.append(message)))
    until(lambda: link.port.is_open)
    clock.begin_stall(link, 2.0)
    line.write(b'\x20\x09')
    until(lambda: link.stale == 2)
    clock.end(link)
    line.write(arduino.encode(arduino.Ticks(77)) + arduino.encode(arduino.Ticks(5)))
    until(lambda: got)
    assert got == [arduino.Ticks(5)]


def test_an_old_frame_behind_a_false_start_is_not_received_when_that_is_given_up(
        line, logger, running, clock):
    """It is found after the stall, but has waited during it."""
    got = []
    link = running(McuLink(Port(line.path), timeout=60.0, logger=logger,
                           on_status=lambda message, seq, stamp: got.append(seq)))

    def frame(seq):
        return mcu.encode(mcu.AdcStatus(1, 2, 3, 4, 5, 6), seq)

    until(lambda: got or line.write(frame(1)))
    clock.begin_stall(link, 2.0)
    before, old = link.stale, b'\x02\x40' + frame(2)     # it would be 67 bytes long
    line.write(old)
    until(lambda: link.stale == before + len(old))
    clock.end(link)
    until(lambda: got[-1] == 3 or line.write(frame(3)))
    assert set(got) == {1, 3}


def test_the_hook_is_called_before_anything_is_received(line, logger, running, clock, monkeypatch):
    told = []
    link = McuLink(Port(line.path), timeout=60.0, logger=logger,
                   on_status=lambda message, seq, stamp: told.append(seq))
    monkeypatch.setattr(link, 'stalled', lambda seconds, now: told.append(seconds))
    running(link)
    until(lambda: told or line.write(mcu.encode(mcu.AdcStatus(1, 2, 3, 4, 5, 6), 1)))
    del told[:]
    clock.begin_stall(link, 40.0)
    assert told[-1] == pytest.approx(40.0, abs=5.0)
    clock.end(link)
    until(lambda: told[-1] == 2 or line.write(mcu.encode(mcu.AdcStatus(1, 2, 3, 4, 5, 6), 2)))


def test_a_callback_that_takes_long_is_a_stall(line, logger, running):
    """Its frame has the stamp of its read; what came meanwhile would get a later one."""
    got = []
    free = threading.Event()

    def on_status(message, seq, stamp):
        got.append(seq)
        if seq == 1:
            free.wait(PATIENCE)

    link = running(McuLink(Port(line.path), timeout=60.0, logger=logger, on_status=on_status))
    until(lambda: got or line.write(mcu.encode(mcu.AdcStatus(1, 2, 3, 4, 5, 6), 1)))
    line.write(mcu.encode(mcu.AdcStatus(1, 2, 3, 4, 5, 6), 2))
    time.sleep(STALL + 0.1)
    free.set()
    until(lambda: link.stale)
    until(lambda: 3 in got or line.write(mcu.encode(mcu.AdcStatus(1, 2, 3, 4, 5, 6), 3)))
    assert 2 not in got


def test_ticks_and_stop_go_on_while_old_bytes_are_dropped(line, logger, clock):
    """However much of it there is."""
    silences = []
    link = McuLink(Port(line.path), timeout=0.1, logger=logger,
                   on_silence=lambda *told: silences.append(told))
    link.start()
    board = Numbers(line.fd, 0.0)
    board.start()
    until(lambda: link.frames_received)
    clock.begin_stall(link, 5.0)
    del silences[:]
    until(lambda: silences)
    assert link.drops
    began = time.monotonic()
    link.stop()
    link.join()
    assert time.monotonic() - began < 1.0 and not link.port.is_open
    board.stop()


def test_no_request_leaves_while_replies_are_dropped(line, logger, running, clock):
    link = running(BusLink(Port(line.path), BusSettings(environment_period=0.0), logger=logger))
    board = running(BusBoard(line))
    until(lambda: link.master.in_step)
    for moves in range(3):
        clock.begin_stall(link, 1.0)
        seen = len(board.seen)
        caller = Waiter(link.lift, 0, 1)
        caller.name = 'caller'
        waited = time.monotonic()
        until(lambda: time.monotonic() > waited + 0.2)
        assert len(board.seen) == seen
        clock.end(link)
        assert caller.result().success and len(board.moves()) == moves + 1
    assert link.master.timeouts == 0, 'an ECHO whose reply was dropped'


# -- how much is old ------------------------------------------------------------------------------

def drop(backlog, now, period, size):
    """Read so many bytes every `period` s from `now` on; when the last old ones were read."""
    for count in range(1, 100000):
        if backlog.drop(bytes(size), now + count * period):
            return now + count * period
    raise AssertionError('for ever')


@pytest.mark.parametrize('stall, believed', [(0.31, 0.1), (2.0, 0.5), (60.0, 1.0)])
def test_a_line_is_believed_the_later_the_longer_the_stall_was(stall, believed):
    assert drop(Backlog(115200, stall, 50.0), 50.0, 0.01, 115) == pytest.approx(
        50.0 + believed, abs=0.011)
    assert drop(Backlog(115200, stall, 50.0), 50.0, 0.1, 0) == pytest.approx(
        50.0 + believed, abs=0.101)
    assert drop(Backlog(115200, stall, 50.0), 50.0, 1.5, 17000) == pytest.approx(51.5)


def test_what_comes_faster_than_the_line_waited_somewhere():
    backlog = Backlog(115200, 0.31, 50.0)
    for count in range(1, 31):      # 40 kB in 0.3 s
        assert not backlog.drop(bytes(1400), 50.0 + count * 0.01)
    assert drop(backlog, 50.3, 0.01, 100) == pytest.approx(50.5, abs=0.11)
    assert backlog.size > 42000


def test_a_line_that_is_faster_than_its_baud_rate_says_is_believed_in_the_end():
    assert drop(Backlog(9600, 0.31, 50.0), 50.0, 0.01, 1000) == pytest.approx(60.0, abs=0.2)


def test_another_stall_meanwhile_begins_anew():
    backlog = Backlog(115200, 1.0, 50.0)
    assert not backlog.drop(b'old', 50.09)
    backlog.extend(2.0, 52.0)
    assert not backlog.drop(b'old', 52.74)
    assert backlog.drop(b'', 52.76)
    assert (backlog.size, backlog.seconds, backlog.last) == (6, 3.0, b'old')
