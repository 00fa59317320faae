"""The port, over real ttys, over sockets, and over kinds without a descriptor."""
import getpass
import os
import re
import shutil
import socket
import subprocess
import sys
import threading
import time

import pytest
from fake_boards import PATIENCE, until
from lines import Rfc2217Server
from waiting import Waiter

from serial_communication.transport.pace import set_priority
from serial_communication.transport.holders import Holder, holders_of
from serial_communication.transport.port import Port, PortBusy, PortError
from serial_communication.transport.urls import check_url, read_url


class Reader:
    """A thread that reads the port, as every link has one."""

    def __init__(self, port, timeout=None):
        self.got = []
        self.error = None
        self.returned = 0
        self._port, self._timeout = port, timeout
        self._ending = False
        self._thread = threading.Thread(target=self._run, name='reader', daemon=True)
        self._thread.start()

    def _run(self):
        while not self._ending:
            try:
                self.got.append(self._port.read(self._timeout))
            except PortError as error:
                self.error = error
                return
            self.returned += 1

    def stop(self):
        self._ending = True
        self._port.wake()
        self._thread.join(PATIENCE)
        assert not self._thread.is_alive()


# -- reading --------------------------------------------------------------------------------------

def test_a_read_returns_all_bytes_received(port, line):
    line.write(b'one')
    assert port.read(PATIENCE) == b'one'
    line.write(b'two')
    line.write(b'three')
    until(lambda: port._open._serial.in_waiting == 8)
    assert port.read(0) == b'twothree'
    assert port.read(0) == b''
    assert port.bytes_received == 11


def test_a_read_sleeps_until_bytes_are_received(port, line):
    before = time.thread_time()
    timer = threading.Timer(0.2, line.write, (b'late',))
    timer.name = 'writer'
    timer.start()
    assert port.read(None) == b'late'
    assert time.thread_time() - before < 0.1, 'it did not sleep'
    timer.join()


def test_a_reader_of_real_time_priority_sleeps_once_for_each_packet(port, line):
    """A poll that waits for the kernel's worker would put it to sleep a second time."""
    packet, count = b'a packet of 22 bytes..', 200

    def read():
        if not set_priority(10):
            raise PermissionError
        for _ in range(count):
            port.read(PATIENCE)
        with open('/proc/thread-self/status') as file:
            return int(re.search(r'^voluntary\D*(\d+)', file.read(), re.MULTILINE)[1])

    reader = Waiter(read)
    for number in range(1, count + 1):
        line.write(packet)
        until(lambda: port.bytes_received == number * len(packet) or reader.error, every=0.001)
    if isinstance(reader.error, PermissionError):
        pytest.skip('this user may not have real-time priority')
    assert reader.result() < 1.15 * count


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


def test_all_bytes_pass_unchanged(port, line):
    every = bytes(range(256)) * 4
    line.write(every)
    got = b''
    while len(got) < len(every):
        got += port.read(PATIENCE)
    assert got == every
    port.write(every)
    assert line.read_all() == every
    assert (port.bytes_received, port.bytes_sent) == (len(every), len(every))


def test_a_read_of_a_removed_device_raises_port_error(port, line):
    reader = Reader(port)
    line.unplug()
    until(lambda: reader.error)
    assert str(reader.error) == 'the device has gone'
    with pytest.raises(PortError):
        port.write(b'x')


def test_a_socat_port_can_be_opened_again_after_it_returns(tmp_path):
    path = str(tmp_path / 'tty')
    other = str(tmp_path / 'other')
    command = ['socat', 'pty,raw,echo=0,link=' + path, 'pty,raw,echo=0,link=' + other]
    port = Port(path)
    for _ in range(2):
        socat = subprocess.Popen(command)
        try:
            until(lambda: os.path.exists(path) and os.path.exists(other))
            port.open()
            far = Port(other)
            far.open()
            port.write(b'there')
            assert far.read(PATIENCE) == b'there'
            far.write(b'and back')
            assert port.read(PATIENCE) == b'and back'
            far.close()
        finally:
            socat.terminate()
            socat.wait(PATIENCE)
        with pytest.raises(PortError):
            while True:
                port.read(PATIENCE)
        port.close()
        assert not port.is_open


# -- opening --------------------------------------------------------------------------------------

def refusal(url):
    port = Port(url)
    with pytest.raises(PortError) as error:
        port.open()
    assert not port.is_open
    return str(error.value)


def test_opening_what_is_not_a_serial_port_reports_why(tmp_path):
    (tmp_path / 'file').write_text('text')
    assert refusal(str(tmp_path / 'missing')) == 'there is no such device; waiting for it'
    assert refusal(str(tmp_path)) == 'this is a directory, not a serial port'
    assert refusal(str(tmp_path / 'file')) == 'this is not a serial port'
    assert refusal('/dev/null') == 'this is not a serial port'
    os.symlink(str(tmp_path / 'nowhere'), str(tmp_path / 'dangling'))
    assert refusal(str(tmp_path / 'dangling')) == 'there is no such device; waiting for it'
    assert refusal('hwgrep://no-such-device-is-here')


@pytest.mark.parametrize('mode, group, words', [
    (0o660, 'dialout', 'join the group that owns it (sudo usermod -a -G dialout $USER)'),
    (0o660, 'uucp', 'join the group that owns it (sudo usermod -a -G uucp $USER)'),
    (0o600, 'dialout', 'only root may open it'), (0o660, 'root', 'only root may open it')])
def test_a_denied_permission_is_reported_with_its_group_or_owner(
        tmp_path, line, mode, group, words):
    target = os.path.realpath(line.path)
    os.chmod(str(tmp_path), 0o755)
    root = os.geteuid() == 0
    if root:
        shutil.chown(target, 'root', group)
    else:
        mode, words = 0, f'only {getpass.getuser()} may open it'
    os.chmod(target, mode)
    groups = os.getgroups()
    if root:
        os.setgroups([])    # after a login root is a member of its own group
        os.setegid(65534)
        os.seteuid(65534)
    try:
        error = refusal(target)
    finally:
        if root:
            os.seteuid(0)
            os.setegid(0)
            os.setgroups(groups)
    assert error.startswith('permission denied; ' + words)


def test_a_port_is_opened_exclusively(port, line):
    assert refusal(line.path) == f'this program itself has it open (pid {os.getpid()})'
    port.close()
    again = Port(line.path)
    again.open()
    again.close()


_HOLDER = '''
import sys, time, serial
port = serial.Serial(sys.argv[1], exclusive=True)
print('open', flush=True)
time.sleep(600)
'''


def test_the_program_that_has_a_port_open_is_named(line, tmp_path):
    script = tmp_path / 'holds_it'
    script.write_text(_HOLDER)
    with subprocess.Popen([sys.executable, str(script), line.path], stdout=subprocess.PIPE) as held:
        try:
            assert held.stdout.readline() == b'open\n'
            names = holders_of(line.path)
            assert Holder(held.pid, 'holds_it') in names
            assert refusal(line.path).startswith('another program has it open: ')
            assert f'holds_it (pid {held.pid})' in refusal(line.path)
        finally:
            held.kill()
    assert Holder(held.pid, 'holds_it') not in holders_of(line.path)


def test_the_holder_is_looked_up_once_for_many_tries(line, monkeypatch):
    looked_up = []
    monkeypatch.setattr('serial_communication.transport.port_errors.holders_of',
                        lambda path: looked_up.append(path) or [])
    port = Port(line.path, 115200)
    holder = Port(line.path, 115200)
    for _ in range(2):
        holder.open()
        for _ in range(3):
            with pytest.raises(PortError, match='another program has it open'):
                port.open()
        assert looked_up == [line.path]
        holder.close()
        port.open()         # so the next holder may be another one
        port.close()
        looked_up.clear()


def test_a_holder_that_cannot_be_seen_is_found_with_a_command(line, port, monkeypatch):
    monkeypatch.setattr('serial_communication.transport.port_errors.holders_of', lambda path: [])
    assert refusal(line.path) == ('another program has it open, of another user: `sudo fuser -v '
                                  f'{line.path}` names it')


@pytest.mark.parametrize('url, lower, scheme', [
    ('SOCKET://Host:1', 'socket://Host:1', 'socket'), ('Rfc2217://h:1', 'rfc2217://h:1', 'rfc2217'),
    ('Hwgrep://0403:6001', 'hwgrep://0403:6001', 'hwgrep'), ('LOOP://', 'loop://', 'loop'),
    ('/dev/ttyUSB0', '/dev/ttyUSB0', ''), ('/tmp/SOCKET:x', '/tmp/SOCKET:x', '')])
def test_a_scheme_is_the_same_in_any_case(url, lower, scheme):
    assert read_url(url) == (lower, scheme)
    assert Port(url).is_network == (scheme in ('socket', 'rfc2217'))


def test_a_url_in_capitals_can_be_opened():
    port = Port('LOOP://')
    port.open()
    port.write(b'round')
    until(lambda: port.read(0.1) == b'round')
    port.close()
    assert refusal('Hwgrep://no-such-device-is-here') == 'no device matches; waiting for one'


@pytest.mark.parametrize('name', ['ptmx', 'link to it'])
def test_ptmx_is_refused_and_makes_no_pseudo_terminal(tmp_path, name):
    path = '/dev/ptmx'
    if name != 'ptmx':
        path = str(tmp_path / 'ptmx')
        os.symlink('/dev/ptmx', path)
    before = set(os.listdir('/dev/pts'))
    assert 'makes a new pseudo terminal at each opening' in refusal(path)
    with pytest.raises(ValueError) as refused:
        check_url(path)
    assert str(refused.value).startswith(path + ' makes a new pseudo terminal')
    assert set(os.listdir('/dev/pts')) == before


def test_a_closed_port_raises_on_read_and_write_and_can_be_opened_again(port):
    port.close()
    port.close()
    with pytest.raises(PortError):
        port.write(b'x')
    with pytest.raises(PortError):
        port.read(0)
    port.discard_output()
    assert port.backlog() == 0.0
    port.open()
    assert port.is_open


# -- writing, to a peer that stops reading --------------------------------------------------------

def frame(number):
    """A frame that differs from every other, wherever it is cut."""
    return b'<%06d:' % number + bytes((65 + number % 26,)) * (number * 37 % 1500) + b'>'


def fill(port, first=0):
    """Write frames until the port takes no more; return the numbers of those that it took."""
    taken = []
    deadline = time.monotonic() + PATIENCE
    for number in range(first, first + 100000):
        assert time.monotonic() < deadline
        try:
            port.write(frame(number))
        except PortBusy:
            return taken
        taken.append(number)
    raise AssertionError('the port takes everything')


def test_a_write_to_a_full_port_does_not_block(port):
    fill(port)
    begun = time.monotonic()
    refused = 0
    while refused < 100:        # the kernel may still make room for a few more
        try:
            port.write(b'x' * 100)
        except PortBusy:
            refused += 1
        assert time.monotonic() - begun < 2.0


def test_a_partly_written_frame_is_completed_before_the_next(port, line):
    taken = fill(port)
    assert port._rest, 'the kernel took whole frames only; this test needs other sizes'
    received = line.read(PATIENCE)
    number = 200000
    while number < 200020:
        try:
            port.write(frame(number))
        except PortBusy:
            received += line.read(PATIENCE)
            continue
        taken.append(number)
        number += 1
    reader = Reader(port)
    expected = b''.join(map(frame, taken))
    deadline = time.monotonic() + PATIENCE
    while len(received) < len(expected) and time.monotonic() < deadline:
        received += line.read(0.1)
    reader.stop()
    assert received == expected
    assert port.bytes_sent == len(expected)


def test_the_reading_thread_completes_a_partly_written_frame(port, line):
    reader = Reader(port)
    taken = fill(port)
    expected = b''.join(map(frame, taken))
    received = b''
    deadline = time.monotonic() + PATIENCE
    while len(received) < len(expected) and time.monotonic() < deadline:
        received += line.read(0.1)
    assert received == expected
    before = reader.returned
    assert line.read(0.1) == b'' and reader.returned <= before + 2, 'it spins'
    reader.stop()


def test_frames_of_several_threads_are_not_mixed(port, line):
    taken, lock = [], threading.Lock()

    def write(base):
        for number in range(base, base + 60):
            while True:
                try:
                    port.write(frame(number))
                    break
                except PortBusy:
                    time.sleep(0.001)
            with lock:
                taken.append(number)

    reader = Reader(port)
    writers = [threading.Thread(target=write, args=(base,), name='writer %d' % base)
               for base in (1000, 2000, 3000)]
    for writer in writers:
        writer.start()
    size = sum(len(frame(number)) for base in (1000, 2000, 3000)
               for number in range(base, base + 60))
    received = b''
    deadline = time.monotonic() + PATIENCE
    while len(received) < size and time.monotonic() < deadline:
        received += line.read(0.05)
    for writer in writers:
        writer.join(PATIENCE)
    reader.stop()
    at = 0
    seen = []
    while at < len(received):
        number = int(received[at + 1:at + 7])
        assert received.startswith(frame(number), at)
        seen.append(number)
        at += len(frame(number))
    assert sorted(seen) == sorted(taken) and len(seen) == 180


def test_discard_output_drops_the_rest_of_a_frame(port, line):
    taken = fill(port)
    port.discard_output()
    received = line.read_all()
    assert b''.join(map(frame, taken)).startswith(received)
    assert len(received) < sum(len(frame(number)) for number in taken)
    port.write(b'new')
    assert line.read_all() == b'new'


def test_closing_does_not_wait_for_a_peer_that_stopped_reading(port):
    fill(port)
    begun = time.monotonic()
    port.close()
    assert time.monotonic() - begun < 2.0


def test_nothing_old_is_sent_after_reopening(port, line):
    fill(port)
    port.close()
    line.read_all()
    port.open()
    port.write(b'new')
    assert line.read_all().endswith(b'new')


# -- other kinds of port --------------------------------------------------------------------------

def test_a_socket_reads_writes_and_wakes(free_server):
    port = Port('socket://127.0.0.1:%d' % free_server.getsockname()[1])
    port.open()
    peer, _ = free_server.accept()
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
    port.close()


def test_a_write_to_a_full_socket_does_not_block_and_nothing_taken_is_lost(free_server):
    port = Port('socket://127.0.0.1:%d' % free_server.getsockname()[1])
    port.open()
    peer, _ = free_server.accept()
    taken = fill(port)
    reader = Reader(port)
    peer.settimeout(PATIENCE)
    received = b''
    # Read at once: the kernel ends a connection whose peer takes nothing for some seconds.
    while not received.endswith(frame(taken[-1])):
        received += peer.recv(1 << 20)
    assert received == b''.join(map(frame, taken))
    peer.close()
    reader.stop()
    port.close()


@pytest.fixture
def rfc2217(free_server, line):
    """A server of telnet with serial options, as ser2net is."""
    server = Rfc2217Server(free_server, line.path)
    yield server
    server.end()


def test_rfc2217_passes_bytes_both_ways(rfc2217, line):
    port = Port(rfc2217.url, 57600)
    port.open()
    port.write(b'\xff\x00down')
    assert line.read_all() == b'\xff\x00down'
    line.write(b'\xff\x00up')
    got = b''
    while len(got) < 4:
        got += port.read(PATIENCE)
    assert got == b'\xff\x00up'
    port.close()


def narrow(port):
    """Make its buffer small, since the server takes long for each byte."""
    port._open._serial._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 16)


def test_a_write_to_an_rfc2217_server_that_stops_reading_does_not_block(rfc2217, line):
    port = Port(rfc2217.url)
    port.open()
    narrow(port)
    rfc2217.stop_reading()
    taken = fill(port)
    begun = time.monotonic()
    for _ in range(100):
        with pytest.raises(PortBusy):
            port.write(b'x' * 70000)
    assert time.monotonic() - begun < 2.0
    assert port.backlog() > 1.0
    rfc2217.go_on()
    reader = Reader(port, 1.0)
    expected, received = b''.join(map(frame, taken)), b''
    deadline = time.monotonic() + PATIENCE
    while len(received) < len(expected) and time.monotonic() < deadline:
        received += line.read(0.1)
    assert received == expected, 'not every byte that was taken arrived once and in order'
    reader.stop()
    port.close()


@pytest.mark.parametrize('kind', ['socket', 'rfc2217', 'SOCKET', 'RFC2217'])
def test_unsent_bytes_of_a_connection_that_is_given_up_are_never_sent(free_server, line, kind):
    url = f'{kind}://127.0.0.1:{free_server.getsockname()[1]}'
    if kind.lower() == 'rfc2217':
        server = Rfc2217Server(free_server, line.path)
        port = Port(url)
        port.open()
        server.stop_reading()
        peer = until(lambda: server.peer)
    else:
        port = Port(url)
        port.open()
        peer, _ = free_server.accept()
    fill(port)
    assert port.discard_output() is False, 'unsent bytes cannot be dropped'
    with pytest.raises(PortError):
        port.write(b'more')
    with pytest.raises(PortError) as error:
        port.read(PATIENCE)
    assert str(error.value) == 'the peer takes no data'
    written = port.bytes_sent
    port.close()
    received = 0
    peer.settimeout(PATIENCE)
    with pytest.raises(ConnectionResetError):
        while True:
            part = peer.recv(1 << 20)
            assert part, 'the connection was closed, not reset'
            received += len(part)
    assert received < written, 'the kernel went on sending it'
    if kind.lower() == 'rfc2217':
        server.end()
    peer.close()


def test_sent_bytes_of_a_connection_arrive_though_it_is_closed(free_server):
    port = Port('socket://127.0.0.1:%d' % free_server.getsockname()[1])
    port.open()
    peer, _ = free_server.accept()
    port.write(b'the last')
    until(lambda: not port.on_its_way())
    port.close()
    peer.settimeout(PATIENCE)
    assert peer.recv(100) == b'the last' and peer.recv(100) == b''
    peer.close()


def test_a_vanished_peer_is_detected_within_5_s(free_server):
    """With and without a write meanwhile; both at once, since it takes so long."""
    def trouble(port):
        with pytest.raises(PortError) as error:
            while True:
                port.read(PATIENCE)
        return str(error.value)

    vanished = []
    for writes in False, True:
        port = Port('socket://127.0.0.1:%d' % free_server.getsockname()[1])
        port.open()
        peer, _ = free_server.accept()
        vanish(peer)
        if writes:
            port.write(b'anybody?')
        vanished.append((port, peer, Waiter(trouble, port)))
    for port, peer, reader in vanished:
        assert reader.result() == 'the host does not answer'
        assert 1.0 < reader.took < 6.0
        port.close()
        peer.close()


def vanish(peer):
    """Make the peer's kernel drop every packet without an answer: no packet has so high a TTL.

    Any user may set that. A filter (SO_ATTACH_FILTER) needs root on some kernels.
    """
    peer.setsockopt(socket.IPPROTO_IP, 21, 255)     # IP_MINTTL


@pytest.fixture
def free_server():
    server = socket.socket()
    server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 14)
    server.bind(('127.0.0.1', 0))
    server.listen(1)
    server.settimeout(PATIENCE)
    yield server
    server.close()


def test_a_port_without_a_descriptor_is_read_in_slices():
    port = Port('loop://')
    port.open()
    port.write(b'round')
    got = b''
    while len(got) < 5:
        got += port.read(PATIENCE)
    assert got == b'round'
    begun = time.monotonic()
    assert port.read(0.1) == b'' and time.monotonic() - begun >= 0.09
    assert port.read(0) == b''
    reader = Reader(port)
    port.wake()
    until(lambda: reader.returned)
    reader.stop()
    assert port.backlog() == 0.0
    port.close()
    with pytest.raises(PortError):
        port.read(0)
