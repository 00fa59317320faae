"""The port, over real ttys, over sockets, and over kinds without a descriptor."""
import contextlib
import os
import socket
import threading
import time

import pytest
import serial
import serial.rfc2217
from waiting import PATIENCE, Waiter, again_if_stalled, all_of, until

from serial_communication.transport.port import Port, PortBusy, PortError


class Reader(threading.Thread):
    """Reads the port until it fails or `stop`, as every link does."""

    def __init__(self, port, timeout=None):
        super().__init__(name='reader', daemon=True)
        self.error, self.returned = None, 0
        self._port, self._timeout, self._ending = port, timeout, False
        self.start()

    def run(self):
        try:
            while not self._ending:
                self._port.read(self._timeout)
                self.returned += 1
        except PortError as error:
            self.error = error

    def stop(self):
        self._ending = True
        self._port.wake()
        self.join(PATIENCE)
        assert not self.is_alive()


# -- reading --------------------------------------------------------------------------------------

def test_a_read_returns_all_bytes_received(port, line):
    line.write(b'one')
    assert port.read(PATIENCE) == b'one'
    line.write(b'two')
    line.write(b'three')
    until(lambda: port._opened._serial.in_waiting == 8)
    assert port.read(0) == b'twothree'
    assert port.read(0) == b''
    assert port.bytes_received == 11


def test_reads_without_a_wait_return_all_that_was_received(port, line):
    """A tty has room for 4095 bytes; the kernel's worker delivers more once they are read."""
    burst, missed = bytes(range(250)) * 80, []
    for _ in range(200):
        sent, got = os.write(line.fd, burst), b''
        while True:
            data = port.read(0)
            if not data:
                break
            got += data
        missed.append(sent - len(got))
        got += all_of(port.read, sent - len(got))
        assert got == burst[:sent] and sent > 8000
    assert not any(missed), missed


def test_a_read_sleeps_until_bytes_are_received(port, line):
    before = time.thread_time()
    timer = threading.Timer(0.2, line.write, (b'late',))
    timer.name = 'writer'
    timer.start()
    assert port.read(None) == b'late'
    assert time.thread_time() - before < 0.1, 'it did not sleep'
    timer.join()


def test_a_read_ends_after_its_timeout(port):
    begun = time.monotonic()
    assert port.read(0.1) == b''
    assert time.monotonic() - begun >= 0.09
    assert port.read(-1.0) == b''


def test_wake_ends_a_sleeping_read_and_a_later_one(port):
    port.wake()
    assert port.read(None) == b''
    reader = Reader(port)
    for count in range(1, 4):
        port.wake()
        until(lambda: reader.returned >= count)
    reader.stop()
    for _ in range(100000):      # more than the pipe holds
        port.wake()
    assert port.read(None) == b''


def test_a_read_of_a_removed_device_raises_port_error(port, line):
    reader = Reader(port)
    line.unplug()
    until(lambda: reader.error)
    assert str(reader.error) == 'the device has gone'
    with pytest.raises(PortError):
        port.write(b'x')


# -- opening --------------------------------------------------------------------------------------


def test_a_port_is_opened_exclusively(port, line):
    again = Port(line.path)
    with pytest.raises(PortError):
        again.open()
    assert not again.is_open
    port.close()
    again.open()
    again.close()


def test_a_closed_port_raises_on_read_and_write_and_can_be_opened_again(port):
    port.close()
    port.close()
    with pytest.raises(PortError):
        port.write(b'x')
    with pytest.raises(PortError):
        port.read(0)
    assert port.renew() == port.unsent() == 0
    port.open()
    assert port.is_open


# -- writing, to a peer that stops reading --------------------------------------------------------

def frame(number):
    """A frame that differs from every other, wherever it is cut."""
    return b'<%06d:' % number + bytes((65 + number % 26,)) * (number * 37 % 1500) + b'>'


def fill(port):
    """Write frames until the port takes no more; return the numbers of those that it took."""
    taken = []
    deadline = time.monotonic() + PATIENCE
    for number in range(100000):
        assert time.monotonic() < deadline
        try:
            port.write(frame(number))
        except PortBusy:
            return taken
        taken.append(number)
    raise AssertionError('the port takes everything')


def test_no_frame_is_taken_before_the_rest_of_the_last_one_is_sent(port, line, monkeypatch):
    send = port._opened.send
    monkeypatch.setattr(port._opened, 'send', lambda data: send(data[:3]))
    port.write(b'abcdefgh')
    with pytest.raises(PortBusy):
        port.write(b'lost')
    port.write(b'ijk')
    assert line.read_all() == b'abcdefghijk' and port.bytes_sent == 11


def test_the_reading_thread_completes_a_partly_written_frame(port, line):
    reader = Reader(port)
    taken = fill(port)
    expected = b''.join(map(frame, taken))
    received = all_of(line.read, len(expected))
    assert received == expected
    before = reader.returned
    assert line.read(0.1) == b'' and reader.returned <= before + 2, 'it spins'
    reader.stop()


def test_frames_of_several_threads_are_not_mixed(port, line):
    shares = [range(base, base + 60) for base in (1000, 2000, 3000)]

    def write(numbers):
        for number in numbers:
            while True:
                try:
                    port.write(frame(number))
                    break
                except PortBusy:
                    time.sleep(0.001)

    reader = Reader(port)
    writers = [Waiter(write, share) for share in shares]
    received = all_of(line.read, sum(len(frame(number)) for share in shares for number in share))
    for writer in writers:
        writer.result()
    reader.stop()
    seen = []
    while received:
        seen.append(int(received[1:7]))
        assert received.startswith(frame(seen[-1]))
        received = received[len(frame(seen[-1])):]
    assert sorted(seen) == [number for share in shares for number in share]


def test_renew_drops_the_rest_of_a_frame(port, line):
    taken = fill(port)
    port.renew()
    received = line.read_all()
    assert b''.join(map(frame, taken)).startswith(received)
    assert len(received) < sum(len(frame(number)) for number in taken)
    port.write(b'new')
    assert line.read_all() == b'new'


def test_a_full_port_sends_no_old_frames_when_it_is_opened_again(port, line):
    fill(port)
    port.close()
    line.read_all()
    port.open()
    port.write(b'new')
    assert line.read_all() == b'new'


# -- other kinds of port --------------------------------------------------------------------------

@pytest.fixture
def free_server():
    with socket.socket() as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 14)
        server.bind(('127.0.0.1', 0))
        server.listen(1)
        server.settimeout(PATIENCE)
        yield server


@pytest.fixture
def connect(free_server):
    """A function that returns an open port and its peer's socket."""
    with contextlib.ExitStack() as opened:
        def connected():
            port = Port('socket://127.0.0.1:%d' % free_server.getsockname()[1])
            port.open()
            opened.callback(port.close)
            peer = opened.enter_context(free_server.accept()[0])
            peer.settimeout(PATIENCE)
            return port, peer
        yield connected


def test_a_socket_reads_writes_and_wakes(connect):
    port, peer = connect()
    peer.sendall(b'hello')
    assert port.read(PATIENCE) == b'hello'
    port.write(b'world')
    assert peer.recv(100) == b'world'
    reader = Reader(port)
    port.wake()
    until(lambda: reader.returned)
    peer.close()
    until(lambda: reader.error)
    assert str(reader.error) == 'the device has gone'


def test_a_write_to_a_full_socket_does_not_block_and_nothing_taken_is_lost(connect):
    port, peer = connect()
    taken = fill(port)
    reader = Reader(port)
    received = b''
    # Read at once: the kernel ends a connection whose peer takes nothing for some seconds.
    while not received.endswith(frame(taken[-1])):
        received += peer.recv(1 << 20)
    assert received == b''.join(map(frame, taken))
    reader.stop()


class Rfc2217Server:
    """A server of telnet with serial options, as ser2net is, for one connection."""

    def __init__(self, listening, path):
        self.url = 'rfc2217://127.0.0.1:%d' % listening.getsockname()[1]
        self.peer = None
        self._going = threading.Event()
        self._going.set()
        self._standing = threading.Event()
        self._ended = threading.Event()
        self._server, self._path = listening, path
        self._thread = threading.Thread(target=self._serve, name='rfc2217 server', daemon=True)
        self._thread.start()

    def stop_reading(self):
        """Stop reading; it has stopped when this returns, until `go_on`."""
        self._standing.clear()
        self._going.clear()
        assert self._standing.wait(PATIENCE)

    def go_on(self):
        self._going.set()

    def end(self):
        self._ended.set()
        self._going.set()
        self._thread.join()

    def _serve(self):
        with self._server:
            self.peer, _ = self._server.accept()
        connection = _Connection(self.peer)
        with self.peer, _Device(self._path, timeout=0.05) as device:
            manager = serial.rfc2217.PortManager(device, connection)
            self.peer.settimeout(0.05)
            while not self._ended.is_set():
                if not self._going.is_set():
                    self._standing.set()
                    self._going.wait()
                    continue
                connection.write(b''.join(manager.escape(device.read(device.in_waiting))))
                try:
                    data = self.peer.recv(65536)
                except socket.timeout:
                    continue
                except OSError:
                    break
                if not data:
                    break       # closed, not reset: the peer knew that all had arrived
                device.write(b''.join(manager.filter(data)))


class _Device(serial.Serial):
    """A pseudo terminal, which has no modem lines."""

    cts = dsr = ri = cd = False
    rts = dtr = True


class _Connection:
    """What a PortManager writes its answers to."""

    def __init__(self, peer):
        self._peer = peer

    def write(self, data):
        try:
            self._peer.sendall(data)
        except OSError:
            pass    # the peer no longer reads; what it sent can still be read


@pytest.fixture
def rfc2217(free_server, line):
    server = Rfc2217Server(free_server, line.path)
    yield server
    server.end()


def test_rfc2217_passes_bytes_both_ways(rfc2217, line):
    port = Port(rfc2217.url, 57600)
    port.open()
    port.write(b'\xff\x00down')
    assert all_of(line.read, 6) == b'\xff\x00down'
    line.write(b'\xff\x00up')
    assert all_of(port.read, 4) == b'\xff\x00up'
    port.close()


def narrow(port):
    """Make its buffer small, since the server takes long for each byte."""
    port._opened._serial._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 16)


def test_a_write_to_an_rfc2217_server_that_stops_reading_does_not_block(rfc2217, line):
    port = Port(rfc2217.url)
    port.open()
    narrow(port)
    rfc2217.stop_reading()
    taken = fill(port)
    with pytest.raises(PortBusy):
        port.write(b'x' * 70000)
    assert port.unsent() > 11520
    rfc2217.go_on()
    reader = Reader(port, 1.0)
    expected = b''.join(map(frame, taken))
    received = all_of(line.read, len(expected))
    assert received == expected, 'not every byte that was taken arrived once and in order'
    reader.stop()
    port.close()


@pytest.mark.parametrize('kind', ['socket', 'rfc2217'])
def test_unsent_bytes_of_a_connection_that_is_given_up_are_never_sent(request, kind):
    if kind == 'rfc2217':
        server = request.getfixturevalue('rfc2217')
        port = Port(server.url)
        port.open()
        server.stop_reading()
        peer = until(lambda: server.peer)
        peer.settimeout(PATIENCE)
    else:
        port, peer = request.getfixturevalue('connect')()
    fill(port)
    port.give_up('the peer takes no data')
    with pytest.raises(PortError):
        port.write(b'more')
    with pytest.raises(PortError) as error:
        port.read(PATIENCE)
    assert str(error.value) == 'the peer takes no data'
    written = port.bytes_sent
    port.close()
    received = 0
    with pytest.raises(ConnectionResetError):
        while True:
            part = peer.recv(1 << 20)
            assert part, 'the connection was closed, not reset'
            received += len(part)
    assert received < written, 'the kernel went on sending it'


def test_sent_bytes_of_a_connection_arrive_though_it_is_closed(connect):
    port, peer = connect()
    port.write(b'the last')
    port.drain(PATIENCE)
    port.close()
    assert peer.recv(100) == b'the last' and peer.recv(100) == b''


def test_a_vanished_peer_is_detected_within_5_s(connect):
    """With and without a write meanwhile; both at once, since it takes so long."""
    def trouble(port):
        with pytest.raises(PortError) as error:
            while True:
                port.read(PATIENCE)
        return str(error.value)

    def detected():
        readers = []
        for writes in False, True:
            port, peer = connect()
            # Its kernel drops every packet without an answer: no packet has so high a TTL. Any user
            # may set IP_MINTTL; a filter (SO_ATTACH_FILTER) needs root on some kernels.
            peer.setsockopt(socket.IPPROTO_IP, 21, 255)
            if writes:
                port.write(b'anybody?')
            readers.append(Waiter(trouble, port))
        assert {reader.result() for reader in readers} == {'the host does not answer'}
        return all(1.0 < reader.took < 6.0 for reader in readers)
    again_if_stalled(detected)
