"""wire listen, tap, play and stats as programs, on real ttys."""
import fcntl
import json
import os
import pty
import re
import select
import signal
import socket
import struct
import subprocess
import sys
import time
from functools import partial

import pytest
from lines import Pty
from programs import started
from waiting import PATIENCE, again_if_stalled, until

import crane_scale
from crane_scale import wire as scale

from serial_communication.transport.port import Port
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.framing.announcement import chunks_of
from serial_communication.tools.wire.lines import Settings
from serial_communication.tools.wire.forwarder import Forwarder
from serial_communication.tools.wire.recording import load
from wire_lines import ROOT, settings

pytestmark = pytest.mark.slow
PROGRAM = [sys.executable, ROOT + '/scripts/wire']
HEARTBEAT = arduino.encode(arduino.Heartbeat())
EVERY_BYTE = bytes(range(256)) * 3
PLAIN = {key: value for key, value in os.environ.items() if key != 'PYTHONUNBUFFERED'}
STOP = b'\0' + arduino.encode(arduino.SpeedCommand(0))     # is sent first after a loss


class Tty(Pty):
    """A tty with exact reads."""

    def exactly(self, size):
        """Read `size` bytes, not more."""
        data = b''
        while len(data) < size:
            assert select.select([self.fd], [], [], PATIENCE)[0], f'received only {data.hex()}'
            data += os.read(self.fd, size - len(data))
        return data

    def is_quiet(self):
        return not select.select([self.fd], [], [], 0)[0]


class Program:
    """A running program, with its output in files."""

    def __init__(self, folder, *arguments, stdout=None):
        self.paths = [stdout or folder / 'stdout', folder / 'stderr']
        with open(self.paths[0], 'w') as output, open(self.paths[1], 'w') as errors:
            self.process = subprocess.Popen(PROGRAM + [str(each) for each in arguments],
                                            stdout=output, stderr=errors, cwd=str(folder))

    def lines(self):
        return self.paths[0].read_text().splitlines()

    def stderr(self):
        return self.paths[1].read_text()

    def wait_for_line(self, words, count=1):
        until(lambda: self.stderr().count(words) >= count, words)

    def end(self, number=signal.SIGINT):
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.process.wait(PATIENCE)


@pytest.fixture
def start(tmp_path):
    yield from started(partial(Program, tmp_path))


@pytest.fixture
def ttys(tmp_path):
    made = [Tty(tmp_path / name).plug() for name in ('board', 'computer')]
    yield made
    for one in made:
        one.unplug()


def run(*arguments, **options):
    return subprocess.run(PROGRAM + [str(each) for each in arguments], timeout=PATIENCE, text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options)


def status(number):
    return mcu.encode(mcu.SensorStatus(number, 500, 30.0, 4.0, 5.0), number % 256)


def dropped(program, source):
    """The number of bytes from this end that `listen` or a tap dropped, as it says."""
    return sum(map(int, re.findall(rf'{re.escape(source.path)}: (\d+) bytes that waited',
                                   program.stderr())))


def has_effect(program, source, data, effect):
    """Write data to a port of the program; return whether `effect()` becomes true.

    It does not if the program drops the data, since a stall of this machine made it stale.
    """
    before = dropped(program, source)
    source.write(data)
    until(lambda: effect() or dropped(program, source) > before, 'the data has an effect')
    if effect():
        return True
    time.sleep(0.2)     # after a loss a tap forwards nothing for 0.1 s, without a report
    return False


def shown(program, board, data, count):
    """Write data to a port, again if it is dropped, until so many lines are shown; return them."""
    again_if_stalled(lambda: has_effect(program, board, data,
                                        lambda: len(program.lines()) >= count))
    assert len(program.lines()) == count
    return program.lines()


# -- listen ---------------------------------------------------------------------------------------

def test_listen_shows_and_records_every_frame_and_writes_nothing(ttys, start, tmp_path):
    board = ttys[0]
    program = start('listen', 'mcu', board.path, '--raw', 'kept.txt', '--json')
    program.wait_for_line('open')
    stream = status(1) + b'\x11\x22' + status(2) + status(3)[:7]
    lines = shown(program, board, stream, 4)
    output = [json.loads(line) for line in lines]
    assert [each['frame'] for each in output] == [
        status(1).hex(), '1122', status(2).hex(), status(3)[:7].hex()]
    assert [bool(each['error']) for each in output] == [False, True, False, True]
    assert output[0]['from'] == 'board' and output[0]['gap'] is None and output[1]['gap'] == 0
    assert output[0]['text'].startswith('sensor status: 1 mm 500 mm')
    assert abs(output[0]['time'] - time.time()) < 60
    assert board.is_quiet()
    assert program.end() == 0
    assert '4 frames, 2 of them invalid' in program.stderr()
    assert 'recorded in kept.txt' in program.stderr()
    recording = load(str(tmp_path / 'kept.txt'))
    assert b''.join(read.data for read in recording.reads['mcu']) == stream


def test_listen_waits_for_a_port_and_opens_it_again(tmp_path, start):
    board = Tty(tmp_path / 'late')
    program = start('listen', 'mcu', board.path)
    program.wait_for_line('waiting for it')
    for count in (1, 2):
        board.plug()
        program.wait_for_line('late: open', count)
        shown = len(program.lines())

        def sends():        # repeatedly: what arrives during a stall of this machine is dropped
            board.write(status(count))
            time.sleep(0.1)
            return len(program.lines()) > shown
        until(sends, 'a frame')
        board.unplug()
        program.wait_for_line('opening it again when it returns', count)
    assert program.end() == 0


def test_announced_messages_are_learned_live_and_out_of_recordings(ttys, start, tmp_path):
    text = (b'firmware: nano 1\nforce: {type: 32, ros_type: any/Type, layout: "<h", '
            b'fields: [data], scale: 0.01}\nwrong: {typ: 5}\n')
    force = arduino.encode_raw(32, (1234).to_bytes(2, 'little'))
    board = ttys[0]
    program = start('listen', 'arduino', board.path, '--raw', 'kept.txt')
    program.wait_for_line('open')
    shown(program, board, force + b''.join(map(arduino.encode, chunks_of(text, 40))), 4)
    lines = shown(program, board, force, 5)
    assert 'message type 32 is unknown' in lines[0] and 'announcement 1/3' in lines[1]
    assert lines[4].endswith('force data=12.34')
    assert program.end() == 0
    done = run('listen', 'arduino', tmp_path / 'kept.txt')
    assert done.stdout.count('force data=12.34') == 2, 'those before the announcement, too'
    figures = json.loads(run('stats', tmp_path / 'kept.txt', '--json').stdout)
    types = figures['links']['arduino']['from the board']['types']
    assert {name: each['count'] for name, each in types.items()} == {
        'announcement': 3, 'force': 2}


def test_announced_settings_are_learned_live_and_out_of_recordings(ttys, start, tmp_path):
    text = b'kp: {setting: 1, layout: "<f", unit: "1/s"}\n'
    setting = mcu.encode_raw(253, 1, b'\1' + struct.pack('<f', 2.2))
    board = ttys[0]
    program = start('listen', 'mcu', board.path, '--raw', 'kept.txt')
    program.wait_for_line('open')
    chunk, = chunks_of(text, 60)
    shown(program, board, setting + mcu.encode(chunk, 2), 2)
    lines = shown(program, board, setting, 3)
    assert 'setting number=1 [205 204 12 64]' in lines[0]
    assert lines[2].endswith('setting number=1 kp=2.2 1/s')
    assert program.end() == 0
    done = run('listen', 'mcu', tmp_path / 'kept.txt')
    assert done.stdout.count('kp=2.2 1/s') == 2, 'those before the announcement, too'


def test_listen_names_the_program_that_has_the_port(ttys):
    port = Port(ttys[0].path)
    port.open()
    done = run('listen', 'mcu', ttys[0].path)
    port.close()
    assert done.returncode == 1
    assert f'(pid {os.getpid()})' in done.stderr and 'rostopic echo /serial_msg' in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_listen_ends_quietly_when_its_output_is_closed(ttys):
    program = subprocess.Popen(PROGRAM + ['listen', 'mcu', ttys[0].path], stdout=subprocess.PIPE,
                               stderr=subprocess.PIPE, text=True)
    program.stdout.close()
    while program.poll() is None:
        try:
            os.write(ttys[0].fd, status(1))
        except BlockingIOError:
            pass
        time.sleep(0.01)
    assert program.returncode == 0 and 'Traceback' not in program.stderr.read()
    program.stderr.close()


# -- tap ------------------------------------------------------------------------------------------

def pass_on(program, source, target, data, after_loss=False):
    """Write data to one end of a tap, again if it is dropped; check what the other end receives."""
    def arrives():
        nonlocal after_loss
        if has_effect(program, source, data, lambda: not target.is_quiet()):
            return True
        after_loss = True
        return False
    again_if_stalled(arrives)
    first = STOP if os.path.basename(target.path) == 'board' else b'\0'
    expected = first * after_loss + data
    assert target.exactly(len(expected)) == expected


@pytest.fixture
def tapped(ttys, start):
    board, computer = ttys
    program = start('tap', 'arduino', board.path, computer.path, '--raw', 'kept.txt', '--json')
    program.wait_for_line('open', 2)
    return board, computer, program


def test_tap_forwards_all_bytes_unchanged_both_ways_at_once(tapped, tmp_path):
    board, computer, program = tapped
    for _ in range(3):
        computer.write(EVERY_BYTE)
        board.write(EVERY_BYTE[::-1])
        assert board.exactly(len(EVERY_BYTE)) == EVERY_BYTE
        assert computer.exactly(len(EVERY_BYTE)) == EVERY_BYTE[::-1]
    assert program.end() == 0 and 'could not be forwarded' not in program.stderr()
    reads = load(str(tmp_path / 'kept.txt')).reads['arduino']
    for sent, stream in ((True, EVERY_BYTE * 3), (False, EVERY_BYTE[::-1] * 3)):
        assert b''.join(read.data for read in reads if read.sent == sent) == stream


def test_tap_shows_which_end_sent_a_frame(tapped):
    board, computer, program = tapped
    pass_on(program, computer, board, HEARTBEAT)
    pass_on(program, board, computer, arduino.encode(arduino.Ticks(9)))
    lines = until(lambda: len(program.lines()) == 2 and program.lines(), 'two frames')
    output = sorted(map(json.loads, lines), key=lambda each: each['time'])
    assert [(each['from'], each['text']) for each in output] == [
        ('computer', 'heartbeat'), ('board', 'ticks 9')]


@pytest.mark.parametrize('gone', (0, 1), ids=('board', 'computer'))
def test_tap_continues_after_either_end_vanishes(tapped, gone):
    away, other = tapped[gone], tapped[1 - gone]
    program = tapped[2]
    away.unplug()
    program.wait_for_line('opening it again')

    def is_lost():
        return has_effect(program, other, b'into the void',
                          lambda: 'not forwarded' in program.stderr())
    again_if_stalled(is_lost)
    away.plug()
    program.wait_for_line(': open', 3)
    # No stale bytes come first, and a frame that was cut off is ended.
    pass_on(program, other, away, HEARTBEAT, after_loss=True)
    pass_on(program, away, other, b'back')
    assert program.end() == 0
    lost = 13 + dropped(program, other) + dropped(program, away)
    assert f'{lost} bytes could not be forwarded' in program.stderr()


def test_a_blocked_end_blocks_neither_direction(tapped):
    board, computer, program = tapped

    def blocks():       # repeatedly: what arrives during a stall or just after is dropped
        board.write(bytes(10000))
        return 'not forwarded' in program.stderr()
    until(blocks, 'a tty that nothing reads takes no bytes')
    pass_on(program, computer, board, HEARTBEAT)

    def recovers():
        while not computer.is_quiet():
            os.read(computer.fd, 65536)
        board.write(b'on')      # is lost too while the kernel still holds older bytes
        return 'takes bytes again' in program.stderr()
    until(recovers, 'takes bytes again')


def messages(data, decoder=arduino.BoardDecoder):
    return [frame.message for frame in decoder().feed(data) if not frame.cause]


def test_a_blocked_board_gets_no_stale_command(tapped):
    board, computer, program = tapped
    count = 0

    def blocks():
        nonlocal count
        computer.write(b''.join(arduino.encode(arduino.SteeringCommand((count + each) % 1000))
                                for each in range(50)))
        count += 50
        return 'not forwarded' in program.stderr()
    until(blocks, 'the board takes no bytes')
    received = bytearray()

    def recovers():
        computer.write(HEARTBEAT)
        received.extend(board.read())
        return 'takes bytes again' in program.stderr()
    until(recovers, 'the board takes bytes again')
    received = messages(received + board.read_all(0.3))
    stopped = received.index(arduino.SpeedCommand(0))
    # Bytes already at the board's end of the pseudo terminal cannot be dropped.
    assert received[:stopped] == [arduino.SteeringCommand(each % 1000) for each in range(stopped)]
    assert stopped < count and received[-1] == arduino.Heartbeat()
    assert 'speed 0 is sent first' in program.stderr()
    assert program.end() == 0
    assert 'bytes could not be forwarded' in program.stderr()


def state_of(process):
    with open(f'/proc/{process.pid}/stat') as file:
        return file.read().rpartition(')')[2].split()[0]


def suspended_for_long(program, meanwhile, ends=1):
    """Suspend a tap until it reports, for so many ends, that it dropped what came meanwhile."""
    words = 'were stale and dropped'
    before = program.stderr().count(words)
    program.process.send_signal(signal.SIGSTOP)
    until(lambda: state_of(program.process) == 'T', 'the program is suspended')
    meanwhile()
    time.sleep(1.0)         # the age of these bytes
    program.process.send_signal(signal.SIGCONT)
    program.wait_for_line(words, before + ends)


def test_bytes_that_wait_while_the_tap_is_suspended_are_dropped(tapped, tmp_path):
    board, computer, program = tapped
    pass_on(program, computer, board, HEARTBEAT)

    def meanwhile():
        computer.write(arduino.encode(arduino.SpeedCommand(500)) * 5)
        board.write(arduino.encode(arduino.Ticks(99)) * 5)
    suspended_for_long(program, meanwhile, 2)

    def passes(end, packet):
        end.write(packet)
        other = computer if end is board else board
        return not other.is_quiet()
    ticks = arduino.encode(arduino.Ticks(7))
    until(lambda: passes(computer, HEARTBEAT), 'heartbeats')
    until(lambda: passes(board, ticks), 'ticks')
    to_board, to_computer = board.read_all(0.3), computer.read_all(0.3)
    assert to_board.startswith(STOP + HEARTBEAT)
    assert set(to_board[len(STOP):].split(HEARTBEAT)) == {b''}
    assert to_computer.startswith(b'\0' + ticks)
    assert set(to_computer[1:].split(ticks)) == {b''}
    said = program.stderr()
    assert f'{computer.path}: 25 bytes that waited' in said
    assert f'{board.path}: 20 bytes that waited' in said
    assert program.end() == 0
    kept = b''.join(read.data for read in load(str(tmp_path / 'kept.txt')).reads['arduino'])
    assert b'\x63' not in kept          # it would be recorded at a wrong time


def test_bytes_that_wait_as_the_tap_starts_are_dropped(ttys, start):
    board, computer = ttys
    # New bytes arrive while it opens, as from socat's buffer, which a flush does not reach.

    def opens():        # while bytes arrive, unless this test stalls meanwhile
        program = start('tap', 'arduino', board.path, computer.path)
        while program.stderr().count(': open') < 2:
            computer.write(arduino.encode(arduino.SpeedCommand(500)))
            while not computer.is_quiet():
                os.read(computer.fd, 4096)
            time.sleep(0.01)
        if dropped(program, computer):
            return True
        program.end()
        board.read_all(0.3)
        return False
    again_if_stalled(opens)
    until(lambda: computer.write(HEARTBEAT) or not board.is_quiet(), 'heartbeats')
    first = board.exactly(len(STOP))
    assert first == STOP


@pytest.mark.parametrize('link, wire', [
    ('bus', bytes.fromhex('a506025e01030acc1229')), ('mcu', None)])
def test_an_incomplete_frame_does_not_merge_with_the_next(ttys, start, link, wire):
    board, computer = ttys
    wire = wire or status(1)
    program = start('tap', link, board.path, computer.path)
    program.wait_for_line('open', 2)
    again_if_stalled(lambda: has_effect(program, board, wire[:5],
                                        lambda: not computer.is_quiet()))
    assert computer.exactly(5) == wire[:5]
    suspended_for_long(program, lambda: board.write(wire[5:]))
    until(lambda: board.write(wire) or not computer.is_quiet(), 'frames')
    data = computer.read_all(0.3)
    assert data == wire * (len(data) // len(wire))      # and nothing of the first


class Uart(Port):
    """A pseudo terminal that reports its backlog, as a UART does."""
    held = 0
    dropped = 0

    def backlog(self):
        return self.held * 10.0 / self.baud

    def write(self, frame):
        super().write(frame)
        self.held += len(frame)

    def discard_output(self):
        self.dropped, self.held = self.held, 0
        return super().discard_output()


@pytest.fixture
def uart(ttys):
    port = Uart(ttys[0].path)
    port.open()
    yield port
    port.close()


def forwarder(port, output):
    return Forwarder(port, settings('arduino'), True, output.append)


def test_a_small_backlog_of_a_uart_is_dropped_after_300_ms(uart):
    output = []
    tap = forwarder(uart, output)
    for beat in range(40):
        tap.forward(HEARTBEAT, 10.0 + beat * 0.01)
    # 0.3 s until it is dropped, then 0.1 s of pause, and so on.
    assert 30 * 3 <= uart.dropped <= 32 * 3 and tap.lost >= uart.dropped
    assert output == [f'not forwarded to {uart.url}: the port takes no data; what waited in it '
                      'was dropped; speed 0 is sent first afterwards']


def test_a_uart_that_sends_in_time_loses_nothing(uart, ttys):
    output = []
    tap = forwarder(uart, output)
    for number in range(200):
        tap.forward(HEARTBEAT * 30, 10.0 + number * 0.01)
        uart.held = min(uart.held, 100)        # never empty
        ttys[0].exactly(len(HEARTBEAT) * 30)
    tap.forward(bytes(1030), 12.0)             # the longest frame of all takes its 89 ms
    tap.forward(HEARTBEAT, 12.05)
    assert output == [] and tap.lost == 0 and uart.dropped == 0


@pytest.fixture
def peer():
    """The server's socket of a board behind a network port."""
    with socket.socket() as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        server.bind(('127.0.0.1', 0))
        server.listen()
        server.settimeout(PATIENCE)
        yield server


def url(server):
    return 'socket://127.0.0.1:%d' % server.getsockname()[1]


def accepted(server):
    connection, _ = server.accept()
    connection.settimeout(PATIENCE)
    return connection


def read_to_the_end(connection):
    data = b''
    try:
        while True:
            part = connection.recv(65536)
            if not part:
                return data
            data += part
    except ConnectionResetError:
        return data


def test_a_blocked_network_port_is_connected_again(ttys, start, peer):
    computer = ttys[1]
    program = start('tap', 'arduino', url(peer), computer.path)
    first = accepted(peer)
    program.wait_for_line('open', 2)
    count, deadline = 0, time.monotonic() + PATIENCE
    while 'the connection was closed' not in program.stderr():
        try:
            first.send(arduino.encode(arduino.Ticks(1)))     # it sends, and takes nothing
        except ConnectionError:
            pass     # closed
        computer.write(arduino.encode(arduino.SteeringCommand(1)) * 50)
        while not computer.is_quiet():
            os.read(computer.fd, 65536)
        count += 50
        assert time.monotonic() < deadline, program.stderr()
    second = accepted(peer)
    assert len(messages(read_to_the_end(first))) < count
    until(lambda: computer.write(HEARTBEAT) or select.select([second], [], [], 0)[0],
          'heartbeats')
    assert second.recv(len(STOP), socket.MSG_WAITALL) == STOP
    assert program.end() == 0


def test_a_silent_board_behind_a_network_port_is_connected_again_once(ttys, start, peer):
    """Bytes for it may wait in its kernel, which the tap cannot see."""
    computer = ttys[1]
    program = start('tap', 'arduino', url(peer), computer.path)
    first = accepted(peer)
    program.wait_for_line('open', 2)
    while 'nothing received from the board for 1 s' not in program.stderr():
        computer.write(HEARTBEAT)
        time.sleep(0.01)
    second = accepted(peer)
    until(lambda: computer.write(arduino.encode(arduino.SpeedCommand(400)))
          or select.select([second], [], [], 0.01)[0], 'commands')
    assert arduino.SpeedCommand(400) not in messages(read_to_the_end(first))
    assert second.recv(len(STOP), socket.MSG_WAITALL) == STOP
    deadline = time.monotonic() + 1.5       # a board that calibrates is silent for minutes
    while time.monotonic() < deadline:
        computer.write(HEARTBEAT)
        time.sleep(0.01)
    assert program.end() == 0
    assert program.stderr().count('nothing received from the board') == 1


def test_a_blocked_terminal_does_not_block_the_line(ttys):
    board, computer = ttys
    # Nothing reads its output; the pipe holds 64 KiB by default, and here 4 KiB.
    program = subprocess.Popen(PROGRAM + ['tap', 'arduino', board.path, computer.path],
                               stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    fcntl.fcntl(program.stdout, 1031, 4096)     # F_SETPIPE_SZ
    try:
        for _ in ttys:
            assert b': open' in program.stderr.readline()
        time_out, passed = time.monotonic() + PATIENCE, 0
        while passed < 2400:      # bytes that wait while the whole machine stalls are dropped
            computer.write(arduino.encode(arduino.Ticks(7)))
            if select.select([board.fd], [], [], 1.0)[0]:
                passed += len(os.read(board.fd, 65536))
            assert time.monotonic() < time_out
    finally:
        program.kill()
        program.communicate()


# -- play and stats -------------------------------------------------------------------------------

@pytest.fixture
def kept(tmp_path):
    """A recording of ten frames, 20 ms apart, one of them incomplete."""
    path = tmp_path / 'kept.txt'
    lines = ['# serial_communication wire recording', '# link mcu', '# baud 57600',
             '# began 1763769600.5', '# a comment']
    for number in range(10):
        frame = status(number) if number != 4 else status(number)[:9]
        lines += [f'{number * 0.02:.6f} rx {frame.hex()}', f'{number * 0.02:.6f} tx 00']
    path.write_text('\n'.join(lines) + '\n')
    return path


def frames_of(data):
    return [frame.message.range_1 for frame in mcu.Decoder().feed(data) if frame.message]


def test_play_sends_what_the_board_sent(kept, ttys):
    done = run('play', kept, 'mcu', ttys[0].path, '--json')
    assert done.returncode == 0, done.stderr
    assert frames_of(ttys[0].exactly(16 * 9 + 9)) == [0, 1, 2, 3, 5, 6, 7, 8, 9]
    assert ttys[0].is_quiet()
    output = json.loads(done.stdout)
    assert (output['writes'], output['left_out'], output['rounds'], output['lost']) == (10, 0, 1, 0)
    assert output['late']['p50'] >= 0
    assert '10 writes in 0.2 s' in done.stderr and '0.2 of 0.2 s\n' in done.stderr
    assert '\r' not in done.stderr and '\033' not in done.stderr


def test_play_sends_a_part_at_another_rate(kept, ttys):
    done = run('play', kept, 'mcu', ttys[0].path, '--from', '0.05', '--to', '0:0.13',
               '--rate', '2')
    assert done.returncode == 0, done.stderr
    assert frames_of(ttys[0].exactly(16 * 3 + 9)) == [3, 5, 6]


def test_play_loops_until_it_is_stopped_and_drops_what_the_port_receives(kept, ttys, start):
    program = start('play', kept, 'mcu', ttys[0].path, '--loop', '--rate', '20')
    ttys[0].exactly(16)
    for _ in range(20):
        ttys[0].write(bytes(1000))      # more than a tty holds
    ttys[0].exactly((16 * 9 + 9) * 3)
    assert program.end(signal.SIGTERM) == 0


def test_play_reports_an_empty_part_and_a_port_that_nothing_reads(kept, ttys):
    done = run('play', kept, 'mcu', ttys[0].path, '--rate', '0.001', '--from', '0.17',
               '--to', '0.175')
    assert done.returncode == 1 and 'links in it: mcu' in done.stderr
    text = kept.read_text() + ''.join(f'{1 + number * 0.001:.6f} rx {"02" * 1000}\n'
                                      for number in range(200))
    kept.write_text(text)
    done = run('play', kept, 'mcu', ttys[0].path)
    assert done.returncode == 1 and 'nothing reads the other end' in done.stderr


@pytest.mark.parametrize('line, words', [
    *((line, f'{{kept}}:26: {line.strip()!r} is not SECONDS') for line in (
        '0.1 rx 0', 'x rx 00', '0.1 up 00', '0.1 rx', 'nan rx 00', 'inf rx 00', '1e17 rx 00')),
    ('-5 rx 00', '{kept}:26: the time -5.000000 s goes back'),
    *((line, 'is out of range or not a number') for line in (
        '# began nan', '# began inf', '# began -5', '# began 1e300', '# baud 0', '# baud 1e300',
        '# baud nan'))])
def test_an_invalid_line_of_a_recording_is_reported_in_one_line(kept, line, words):
    heading = line[:line.index(' ', 2) + 1] if line[0] == '#' else None
    lines = kept.read_text().splitlines()
    kept.write_text('\n'.join([line if heading and each.startswith(heading) else each
                               for each in lines] + [line] * (not heading)))
    for program in (['play', kept, 'mcu', '/dev/null'], ['stats', kept], ['listen', 'mcu', kept]):
        done = run(*program)
        assert done.returncode == 1 and words.format(kept=kept) in done.stderr
        assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize('arguments', [
    ['listen', 'mcu', 'kept.txt'], ['listen', 'mcu', 'kept.txt', '--json'], ['stats', 'kept.txt'],
    ['explain', 'mcu', '02 0c'], ['--help']], ids=' '.join)
def test_a_full_disk_is_reported_in_one_line(kept, arguments):
    with open('/dev/full', 'w') as full:
        done = subprocess.run(PROGRAM + arguments, stdout=full, stderr=subprocess.PIPE, text=True,
                              cwd=str(kept.parent), timeout=PATIENCE, env=PLAIN)
    assert done.returncode == 1
    assert done.stderr == 'wire: its output cannot be written: No space left on device\n'


def test_a_full_disk_behind_standard_error_changes_nothing(kept):
    with open('/dev/full', 'w') as full:
        done = subprocess.run(PROGRAM + ['listen', 'mcu', str(kept)], stdout=subprocess.PIPE,
                              stderr=full, text=True, timeout=PATIENCE)
    assert done.returncode == 0 and len(done.stdout.splitlines()) == 11


def test_listen_ends_on_a_full_disk(ttys):
    with open('/dev/full', 'w') as full:
        program = subprocess.Popen(PROGRAM + ['listen', 'mcu', ttys[0].path], stdout=full,
                                   stderr=subprocess.PIPE, text=True)
    assert ': open' in program.stderr.readline()
    until(lambda: program.poll() is not None, 'it ends',
          doing=lambda: ttys[0].write(status(1)), every=0.1)
    said = [line for line in program.stderr.read().splitlines() if 'bytes that waited' not in line]
    program.stderr.close()
    assert program.returncode == 1
    assert said == ['wire: its output cannot be written: No space left on device']


def test_a_tap_continues_on_a_full_disk(ttys, start):
    board, computer = ttys
    program = start('tap', 'arduino', board.path, computer.path, stdout='/dev/full')
    program.wait_for_line(': open', 2)
    for _ in range(20):
        pass_on(program, computer, board, HEARTBEAT)
    words = 'the output cannot be written: No space left on device; nothing more is printed'
    program.wait_for_line(words)
    assert program.end() == 1
    said = [line for line in program.stderr().splitlines() if 'bytes that waited' not in line]
    assert said[2] == words and len(said) == 4      # behind two `open`, before the summary


def test_a_file_that_is_no_recording_is_reported_in_one_line(tmp_path):
    (tmp_path / 'text').write_text('hello\n')
    (tmp_path / 'bytes').write_bytes(b'# serial_communication wire recording\n# link mcu\n\xff\n')
    (tmp_path / 'nobody').write_text('# serial_communication wire recording\n0 rx 00\n')
    for path, words in ((tmp_path / 'text', 'neither a bag nor'), (tmp_path / 'bytes', 'not text'),
                        (tmp_path / 'nobody', '# link'), (tmp_path, 'Is a directory'),
                        (tmp_path / 'missing', 'No such file')):
        done = run('stats', path)
        assert done.returncode == 1 and words in done.stderr
        assert len(done.stderr.splitlines()) == 1


def test_every_byte_of_a_backlog_is_shown_and_counted_but_no_impossible_load(tmp_path):
    """Noise and bytes between packets, read faster than a line carries them."""
    path, noise = tmp_path / 'backlog.txt', bytes(range(1, 101))
    path.write_text('\n'.join([
        '# serial_communication wire recording', '# link arduino', '# baud 115200', '# began 0',
        f'0.0 rx {noise.hex()}', f'0.001 rx {bytes(50).hex()}', '0.002 rx 0102030400']) + '\n')
    assert noise.hex(' ') in run('listen', 'arduino', path).stdout
    board = json.loads(run('stats', path, '--json').stdout)['links']['arduino']['from the board']
    assert (board['bytes'], board['share of capacity']) == (155, None)
    table = run('stats', path).stdout
    assert 'more than the wire carries in this time (some had waited)' in table and '%' not in table


def test_stats_count_frames_errors_and_gaps(kept):
    output = json.loads(run('stats', kept, '--json').stdout)
    assert output['links']['mcu']['baud'] == 57600 and output['seconds'] == pytest.approx(0.18)
    board = output['links']['mcu']['from the board']
    assert (board['frames'], board['invalid'], board['bytes']) == (10, 1, 153)
    assert board['errors'] == {'framing': 1}
    assert board['share of capacity'] == pytest.approx(153 * 10 / 57600 / 0.18)
    types = board['types']['sensor status']
    assert types['count'] == 9 and types['gap p50'] == pytest.approx(0.02)
    assert types['gap max'] == pytest.approx(0.04)
    assert output['links']['mcu']['lost by SEQ'] == 1
    table = run('stats', kept).stdout
    assert '1 invalid' in table and 'invalid: framing' in table and '1 frames lost' in table


def test_stats_have_round_trips_and_heartbeats(tmp_path):
    path = tmp_path / 'bus.txt'
    path.write_text('# serial_communication wire recording\n# link bus\n'
                    '0.0 tx a5025522d0\n0.004 rx a506025e01030acc1229\n'
                    '1.0 tx a5025522d0\n1.5 tx a50255200064b6\n1.508 rx a50002a7\n')
    output = json.loads(run('stats', path, '--json').stdout)['links']['bus']
    trips = output['round trips']
    assert (trips['answered'], trips['unanswered']) == (2, 1)
    assert trips['round trip max'] == pytest.approx(0.008)
    assert set(output['to the board']['types']) == {'environment', 'lift'}
    path.write_text('# serial_communication wire recording\n# link arduino\n' + ''.join(
        f'{at} tx 020b00\n' for at in (0.0, 0.01, 0.02, 0.07)))
    beats = json.loads(run('stats', path, '--json').stdout)['links']['arduino']['heartbeats']
    assert (beats['count'], beats['too_long']) == (4, 1)
    assert beats['gap max'] == pytest.approx(0.05)


def test_stats_have_the_read_delay_of_a_board_that_sends_its_time(tmp_path):
    """From the measurement to the read; the board's clock is 0.2 % fast."""
    path = tmp_path / 'kept.txt'
    lines = ['# serial_communication wire recording', '# link arduino']
    for number in range(300):
        at = number * 0.01
        late = 0.006 if number % 5 == 4 else 0.0005
        wire = arduino.encode(arduino.Time(round(at * 1.002e6), 1)) + arduino.encode(
            arduino.Ticks(1)) + arduino.encode(arduino.Log(1, 'x'))
        lines.append(f'{at + late:.6f} rx {wire.hex()}')
    path.write_text('\n'.join(lines) + '\n')
    types = json.loads(run('stats', path, '--json').stdout)['links']['arduino'][
        'from the board']['types']
    assert types['ticks']['read delay p50'] == pytest.approx(0.0, abs=1e-4)
    assert types['ticks']['read delay max'] == pytest.approx(0.0055, abs=1e-4)
    assert types['INFO']['read delay p50'] is None
    assert 'delay p50' in run('stats', path).stdout


def test_config_makes_custom_messages_known(tmp_path):
    config = os.path.join(ROOT, 'config', 'custom_messages.yaml')
    done = run('explain', 'arduino', '--config', config, '0420f40100')
    assert done.returncode == 0 and 'force' in done.stdout and '(sent as 500)' in done.stdout
    assert run('explain', 'arduino', '0420f40100').returncode == 1
    kept = tmp_path / 'custom.txt'
    kept.write_text('# serial_communication wire recording\n# link arduino\n0 rx 0420f40100\n')
    assert '  force ' in run('stats', kept, '--config', config).stdout
    wrong = tmp_path / 'wrong.yaml'
    wrong.write_text('arduino: {messages: {force: {type: 4}}}')
    for path in wrong, tmp_path / 'missing.yaml':
        done = run('explain', 'arduino', '--config', path, '0420f40100')
        assert done.returncode == 2 and len(done.stderr.splitlines()) == 1


# -- a board of another package -------------------------------------------------------------------

HOLD = scale.encode(scale.Hold(), 0)


def load_frame(number):
    return scale.encode(scale.Load(number / 10), number % 256)


@pytest.fixture
def scale_config(tmp_path, monkeypatch):
    """Parameters of a bridge with the scale; its package is put on the programs' PYTHONPATH."""
    monkeypatch.setenv('PYTHONPATH', os.pathsep.join(
        [os.path.dirname(os.path.abspath(__file__)), os.environ.get('PYTHONPATH', '')]))
    path = tmp_path / 'scale.yaml'
    path.write_text('boards: [crane_scale]\n'
                    'scale: {messages: {tilt: {type: 3, ros_type: std_msgs/Float32, '
                    'layout: "<h", fields: [data], scale: 0.01}}}\n')
    return path


def test_another_board_is_explained_by_its_package_and_by_its_link(scale_config):
    both = HOLD.hex() + load_frame(123).hex()
    by_package = run('explain', 'crane_scale', both)
    assert by_package.returncode == 0, by_package.stderr
    assert re.search(r'7b 00 +value +12.3 kg \(sent as 123\)', by_package.stdout)
    assert run('explain', 'scale', both, '--config', scale_config).stdout == by_package.stdout
    tilt = scale.encode_raw(b'\3\7\x64\0')
    done = run('explain', 'scale', '--config', scale_config, tilt.hex())
    assert done.returncode == 0 and 'tilt' in done.stdout and '(sent as 100)' in done.stdout
    done = run('explain', 'crane_scale', tilt.hex(), load_frame(5).hex()[:-2])
    assert done.returncode == 1
    assert 'not known here' in done.stdout and 'incomplete' in done.stdout


@pytest.mark.parametrize('arguments', [
    ['explain', 'scale', '0200'], ['explain', 'json', '0200'], ['explain', 'no.such.board', '02'],
    ['listen', 'scale', '/dev/null'], ['tap', 'scale', '/dev/null', '/dev/zero'],
    ['play', '{kept}', 'scale', '/dev/null'], ['stats', '{kept}']], ids=' '.join)
def test_an_unknown_board_is_reported_in_one_line(arguments, tmp_path):
    kept = tmp_path / 'scale.txt'
    kept.write_text(f'# serial_communication wire recording\n# link scale\n0 rx {HOLD.hex()}\n')
    done = run(*[each.format(kept=kept) for each in arguments])
    assert done.returncode == 2 and not done.stdout
    assert done.stderr.startswith('wire: there is no board ') and '--config' in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize('by_config', (False, True), ids=('by its package', 'by its link'))
def test_listen_stats_and_play_know_another_board(scale_config, ttys, start, tmp_path, by_config):
    board, computer = ttys
    link = ['scale', '--config', scale_config] if by_config else ['crane_scale']
    program = start('listen', *link, board.path, '--raw', 'kept.txt')
    program.wait_for_line('open')
    stream = load_frame(1) + b'\x11' + load_frame(4)
    lines = shown(program, board, stream, 3)
    assert lines[0].endswith('load 0.1 kg') and lines[2].endswith('load 0.4 kg')
    assert '1 byte outside frames' in lines[1]
    assert program.end() == 0
    kept = tmp_path / 'kept.txt'
    assert '# link scale\n# baud 9600\n' in kept.read_text()
    output = json.loads(run('stats', kept, '--config', scale_config, '--json').stdout)
    output = output['links']['scale']
    assert output['baud'] == 9600 and output['lost by SEQ'] == 2
    assert output['from the board']['types']['load']['count'] == 2
    assert output['from the board']['errors'] == {'framing': 1}
    assert run('listen', *link, kept).stdout.count('load') == 2
    done = run('play', kept, *link, computer.path)
    assert done.returncode == 0 and computer.exactly(len(stream)) == stream


def test_stats_know_another_boards_heartbeats(scale_config, tmp_path):
    kept = tmp_path / 'kept.txt'
    kept.write_text('# serial_communication wire recording\n# link scale\n' + ''.join(
        f'{at} tx {HOLD.hex()}\n' for at in (0.0, 0.1, 0.2, 0.5)))
    done = run('stats', kept, '--config', scale_config)
    assert 'at 9600 baud' in done.stdout and '  hold ' in done.stdout
    assert 'heartbeats: 4,' in done.stdout and '1 gaps over 200 ms' in done.stdout


def test_a_tap_resumes_after_the_end_of_a_frame_of_another_board(uart, ttys):
    output = []
    tap = Forwarder(uart, Settings(crane_scale.DESCRIPTION, 9600), True, output.append)
    stream = b''.join(map(load_frame, range(100)))
    tap.input_dropped(5, 10.0)
    for at in range(0, len(stream), 6):      # never silent for 20 ms, and half a frame at a time
        tap.forward(stream[at:at + 6], 10.0 + at * 0.001)
        uart.held = 0
    received = ttys[0].exactly(len(HOLD) + len(stream) - tap.lost + 5)
    frames = stream[tap.lost - 5:]
    assert received == HOLD + frames and frames.startswith(b':') and output == []
    assert 0 < tap.lost - 5 < len(stream) / 2


# -- the program ----------------------------------------------------------------------------------

@pytest.mark.parametrize('program', ['explain', 'listen', 'tap', 'play', 'stats'])
def test_help_names_the_program(program):
    done = run(program, '--help')
    assert done.returncode == 0 and f'wire {program}' in done.stdout and not done.stderr
    assert run('--help').stdout.count(f'wire {program}') == 1


@pytest.mark.parametrize('arguments', [
    [], ['dance'], ['listen'], ['listen', 'mcu'], ['listen', 'ferry', '/dev/null'],
    ['listen', 'mcu', 'nonsense://x'], ['play', 'a', 'mcu', 'b', '--rate', '0'],
    ['play', 'a', 'mcu', 'b', '--from', 'x'], ['stats'], ['stats', 'a', '--dance'],
    ['listen', 'mcu', '/dev/null', '--duration', 'nan'],
    ['listen', 'mcu', '/dev/null', '--baud', '0'], ['stats', 'a', '--baud', '-1'],
    ['tap', 'mcu', '/dev/null', '/dev/zero', '--frame-timeout', 'nan'],
    ['tap', 'mcu', '/dev/null'], ['tap', 'mcu', '/dev/null', '/dev/null'],
    ['explain', 'mcu', '02', '--dance']])
def test_wrong_arguments_give_status_2(arguments):
    done = run(*arguments)
    assert done.returncode == 2 and 'Traceback' not in done.stderr


BLOCKER = '''
import runpy, sys
class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.split('.')[0] in ('rospy', 'genpy', 'yaml', 'rosbag', 'roslib', 'rospkg',
                                  'rosgraph', 'numpy'):
            raise ImportError(f'{name} is not installed here')
sys.meta_path.insert(0, Blocker())
sys.argv[0] = 'wire'
runpy.run_module('serial_communication.tools.wire', run_name='__main__', alter_sys=True)
'''


@pytest.mark.parametrize('arguments, returned', [
    (['explain', 'bus', 'a50002a7'], 0), (['listen', 'mcu', '{board}', '--duration', '0.2'], 0),
    (['tap', 'arduino', '{board}', '{computer}', '--duration', '0.2'], 0),
    (['stats', '{kept}'], 0), (['--help'], 0)])
def test_pyserial_alone_is_enough(ttys, kept, arguments, returned):
    board, computer = ttys
    arguments = [each.format(board=board.path, computer=computer.path, kept=kept)
                 for each in arguments]
    done = subprocess.run([sys.executable, '-c', BLOCKER] + arguments, cwd=ROOT, timeout=PATIENCE,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                          env={'PATH': os.environ['PATH'], 'PYTHONPATH': ROOT})
    assert done.returncode == returned, done.stderr


def test_a_bag_without_rosbag_is_reported_in_one_line(tmp_path):
    (tmp_path / 'a.bag').write_bytes(b'#ROSBAG V2.0\n')
    done = subprocess.run([sys.executable, '-c', BLOCKER, 'stats', str(tmp_path / 'a.bag')],
                          cwd=ROOT, timeout=PATIENCE, stderr=subprocess.PIPE, text=True,
                          env={'PATH': os.environ['PATH'], 'PYTHONPATH': ROOT})
    assert done.returncode == 1 and 'python3-rosbag' in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_colours_are_for_terminals_only():
    shown = {}
    for environment in ({'TERM': 'xterm'}, {'TERM': 'xterm', 'NO_COLOR': '1'}, {'TERM': 'dumb'}):
        near, far = pty.openpty()
        done = subprocess.Popen(PROGRAM + ['explain', 'mcu', '02 0c'], stdout=far,
                                env=dict(os.environ, **environment))
        assert done.wait(PATIENCE) == 1
        shown[str(environment)] = b'\033[' in os.read(near, 65536)
        os.close(near)
        os.close(far)
    assert list(shown.values()) == [True, False, False]
