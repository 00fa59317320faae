"""The campaign's table, lines, boards and logs."""
import os
import select
import signal
import socket
import struct
import time

import pytest
from waiting import until

import by_definition as codec
from campaign import boards, broken, logs, machine, writes
from campaign.boards import (BusBoard, Car, Reaction, Request, Sensors, imu_values, range_key,
                             reply_frame)
from campaign.lines import Clock, NetworkLine, SerialLine
from campaign.requirements import Table


@pytest.fixture
def line(tmp_path):
    line = SerialLine(str(tmp_path / 'port'))
    yield line
    if line.plugged:
        line.unplug()


def opened(line):
    return os.open(line.port, os.O_RDWR | os.O_NOCTTY)


def test_line_returns_as_another_device(line):
    calls, before = [], os.path.realpath(line.port)
    line.on_unplugged = lambda: calls.append(1)
    line.unplug()
    assert not os.path.exists(line.port) and not line.write(b'x') and calls == [1]
    line.plug(another_name=True)
    assert os.path.realpath(line.port) != before


def test_frozen_line_is_full_and_keeps_its_bytes(line):
    received = []
    line.on_bytes = lambda data, now: received.append(data)
    end = os.open(line.port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    os.write(end, b'before')
    line.freeze()
    assert b''.join(received) == b'before'
    with pytest.raises(BlockingIOError):
        os.write(end, b'after')
    line.thaw()
    until(lambda: len(b''.join(received)) > 4000)
    assert b'after' not in b''.join(received)
    os.close(end)


def test_network_loses_a_connection(tmp_path):
    import socket
    line, received = NetworkLine(str(tmp_path / 'unused')), []
    line.on_bytes = lambda data, now: received.append(data)
    address = '127.0.0.1', int(line.port.rpartition(':')[2])
    with socket.create_connection(address) as first:
        first.sendall(b'one')
        until(lambda: received == [b'one'])
        line.lose_connection()
        first.sendall(b'lost')
        with socket.create_connection(address) as second:
            second.sendall(b'two')
            until(lambda: received == [b'one', b'two'])


def test_car_records_packets_and_heartbeats(line):
    car = Car(line, Clock())
    end = opened(line)
    heartbeat = codec.arduino_packet(codec.HEARTBEAT)
    os.write(end, codec.arduino_packet(codec.SPEED, b'\0\0') + heartbeat * 3
             + codec.arduino_packet(codec.SPEED, struct.pack('<h', -7)))
    until(lambda: len(car.packets) == 2)
    assert car.first.is_stop and car.beats == 3 and car.packets[1].beats == 3
    assert car.stop_after(car.packets[0]) is None and car.gaps == []
    assert car.commands(codec.SPEED) == [0, -7] and car.packet(codec.SPEED, -7)
    line.unplug()
    assert car.connection == 1 and car.beats == 0 and car.first is None and car.last.number == -7
    os.close(end)


def test_boards_record_the_values_that_they_send(line):
    car, sensors = Car(line, Clock()), Sensors(line)
    car.measure()
    assert [each.topic for each in car.sent] == [
        '~ticks', '~steering_angle', '~voltage', '~counter', '~imu', '~imu/temperature',
        'tf/imu_orientation', '~field', '~place', 'tf/place', '~scan']
    assert [each.key for each in car.sent[-4:]] == [
        (1, -1, -14999), (1, -1, -30999), -30999, (1, None, 258)]
    assert [each.key for each in car.sent[:5]] == [1, 1, 1, 1, imu_values(1)[:10]]
    sensors.measure()
    assert [each.key for each in sensors.sent] == [
        (1, True, 1, 7, (999, -4499, -1)), 'near', 'near', (999, -4499, -1), (999, -4499, -1),
        (2, 1, 2, 3, 4, 5, 6)]
    sensors.sent.clear()
    for _ in range(6):
        sensors.measure()
    assert sensors.sent[-4].key == (13, False, 7, 49, (None,) * 3)    # no attitude with it
    sensors._number = 36
    sensors.measure()
    assert sensors.sent[-2].key == (927, -4463, -37)        # 369.27 degrees were sent
    assert [range_key(value) for value in (65535, 29, 30, 2000, 2001)] == [
        'timed out', 'near', 30, 2000, 'far']


@pytest.mark.parametrize('number', [29999, 32767, 36000, 65529, 65534, 65535, 1 << 24])
def test_boards_send_for_any_duration(line, number):
    for board in Car(line, Clock()), Sensors(line):
        board._number = number
        board.measure()
        assert len(board.sent) >= 4
    board = BusBoard(line, Clock())
    board.readings = number
    for cmd2 in boards.POLLS:
        board.ok_reply(Request(0.0, codec.FUNCTION, cmd2, b'', 0))
    assert len(board.sent) == 5


def test_a_gap_between_heartbeats_is_recorded(line):
    car, heartbeat = Car(line, Clock()), codec.arduino_packet(codec.HEARTBEAT)
    for now in (1.0, 1.01, 1.041, 1.05):
        car.read(heartbeat, now)
    assert car.gaps == [(1.01, 1.041)] and car.beat_at == 1.05
    car.forget_beat()
    car.read(heartbeat, 3.0)
    assert len(car.gaps) == 1 and car.all_beats == 5


@pytest.mark.parametrize('next_one', ['heartbeat', 'SPEED 0'])
@pytest.mark.parametrize('silent, not_arrived, gaps', [
    (2.0, (1.02, 1.04), 0), (1.2, (1.02, 1.04), 0), (2.0, (1.02,), 1), (0.1, (1.02, 1.04), 1)])
def test_heartbeats_that_the_bridge_drops_when_a_silence_ends_were_in_time(
        line, monkeypatch, silent, not_arrived, gaps, next_one):
    car, heartbeat, now = Car(line, Clock()), codec.arduino_packet(codec.HEARTBEAT), [-9.0]
    car._last_beat = 0.99
    speed_0 = codec.arduino_packet(codec.SPEED, bytes(2))
    monkeypatch.setattr(boards.time, 'monotonic', lambda: now[0])
    for now[0] in 1.0 - silent, 1.0:
        car.write(b'')
    times = [(1.0, ()), (1.06, not_arrived)] if next_one == 'heartbeat' else \
        [(1.0, ()), (1.05, not_arrived), (1.06, ())]

    def written(frames, now):
        at, line.not_arrived = times.pop(0)
        return [at]
    line.written = written
    for packet in (heartbeat, *[speed_0] * (len(times) - 2), heartbeat):
        car.read(packet, 1.06)
    assert len(car.gaps) == gaps


@pytest.fixture
def talking_car(line, monkeypatch):
    car = Car(line, Clock())
    with monkeypatch.context() as patched:
        patched.setattr(boards.time, 'monotonic', lambda: 0.5)
        car.write(b'')
    return car


@pytest.mark.parametrize('writes, gaps', [
    ((1.01, 1.02, 1.031), []), ((1.03, 1.031), [(1.0, 1.03)]), ((1.031,), [(1.0, 1.031)])])
def test_heartbeats_that_the_kernel_moves_one_by_one_were_in_time(
        line, talking_car, writes, gaps):
    """It has moved the first one when all of them are written."""
    car, heartbeat = talking_car, codec.arduino_packet(codec.HEARTBEAT)
    car._last_beat = 0.99
    noted = [[1.0], list(writes)]
    line._writes.next = lambda seconds=0.0: noted.pop(0) if noted else []
    for now in (1.0, *(1.04 for _ in writes)):
        car.read(heartbeat, now)
    noted.append([1.05])
    car.read(heartbeat, 1.05)
    assert car.gaps == gaps and car.all_beats == 2 + len(writes)


def test_heartbeats_that_the_kernel_moves_one_by_one_for_a_while_were_in_time(line, talking_car):
    """Each has the write of the one two later, until it has moved those that are left."""
    car, heartbeat = talking_car, codec.arduino_packet(codec.HEARTBEAT)
    car._last_beat = 0.99
    noted = [[1.0], [1.01, 1.02, 1.03], [1.04], [1.05]]
    line._writes.next = lambda seconds=0.0: noted.pop(0) if noted else []
    for now, count in (1.0, 1), (1.03, 1), (1.04, 1):
        car.read(heartbeat * count, now)
    assert car.gaps == [(1.0, 1.03)]
    car.read(heartbeat * 3, 1.05)
    assert car.gaps == [] and car.all_beats == 6


def test_a_write_after_a_read_is_of_a_later_heartbeat_unless_it_is_only_noted_later(
        line, talking_car):
    car, heartbeat = talking_car, codec.arduino_packet(codec.HEARTBEAT)
    for now, count, noted, beat_at in (
            (1.0, 1, [1.0], 1.0), (1.011, 2, [1.01, 1.029], 1.01), (1.035, 1, [], 1.029),
            (1.0395, 1, [1.04], 1.0395)):
        line._writes.next = lambda seconds=0.0, noted=noted: noted
        car.read(heartbeat * count, now)
        assert car.beat_at == beat_at


@pytest.mark.parametrize('has_stalled, gaps', [(False, [(1.0, 1.031)]), (True, [])])
def test_heartbeats_that_never_arrive_are_a_gap_but_not_just_after_a_stall(
        line, talking_car, has_stalled, gaps):
    car, heartbeat = talking_car, codec.arduino_packet(codec.HEARTBEAT)
    if not has_stalled:
        car._last_beat = 0.99
    for at, *before in (1.0,), (1.031, 1.01, 1.02), (1.041,):
        line._writes.next = lambda seconds=0.0: [*before, at]
        car.read(heartbeat, at)
    assert car.gaps == gaps


def bus_board(line):
    """A board, and what was wrong about fences."""
    board, faults = BusBoard(line, Clock()), []
    board.check_fence = lambda fence: fence.holds or faults.append(fence.text)
    return board, faults


def test_bus_board_checks_the_fence(line):
    board, faults = bus_board(line)
    echo, lift = codec.bus_frame(b'\1\0', b'nonc'), codec.bus_frame(b'\x55\x20', b'\0\1')
    for data in (echo, lift):
        board.read(data, 1.0)
    assert not faults
    board.read(lift, 2.0)
    assert 'came behind' in faults.pop()
    for data in (echo, lift):
        board.read(data, 3.0)
    assert 'is not new' in faults.pop() and not faults
    board.probe = lambda request: Reaction()     # not answered
    for data in (codec.bus_frame(b'\1\0', b'othe'), lift):
        board.read(data, 4.0)
    assert 'came behind' in faults.pop() and not faults


def test_bus_board_keeps_the_order_of_its_line(line):
    """A delayed reply delays all later ones."""
    board = BusBoard(line, Clock())
    ok = reply_frame(codec.OK)
    board.react = lambda request: Reaction([(0, ok), (0.05, ok)], True)
    end = opened(line)
    os.write(end, codec.bus_frame(b'\x55\x20', b'\0\1') + codec.bus_frame(b'\1\0', b'nonce'))
    wanted, received = ok + ok + reply_frame(codec.ECHO, b'nonce'), b''
    while len(received) < len(wanted):
        received += os.read(end, 100)
    assert received == wanted
    assert board.executed[0x20, b'\0\1'] == 1
    assert [request.key for request in board.requests] == [(0x20, b'\0\1'), (0, b'nonce')]
    assert isinstance(board.requests[0], Request)
    os.close(end)


def test_clock_calls_at_the_given_times():
    clock, done = Clock(), []
    clock.after(0.1, lambda: done.append(('late', time.monotonic())))
    clock.after(0.0, lambda: done.append(('soon', time.monotonic())))
    began = time.monotonic()
    until(lambda: len(done) == 2)
    assert [name for name, _t in done] == ['soon', 'late'] and done[1][1] - began > 0.09


@pytest.mark.parametrize('text, cause', [
    ('mcu: checksum: CRC does not match: 02aa (and 3 more like it)', ('mcu', 'checksum')),
    ('arduino: speed 300 refused: the port is closed', ('arduino', 'speed refused: the port is '
                                                        'closed')),
    ('arduino: says: hello', ('', '')), ('something else', ('', ''))])
def test_cause_of_a_log_line(text, cause):
    assert logs.cause_of(text) == cause


def test_log_lines_of_the_bridge(tmp_path):
    table = Table()
    check = logs.LogCheck(str(tmp_path), table.row)

    def log(second, text, logger='rosout'):
        with open(str(tmp_path / 'bridge_1.log'), 'a') as file:
            file.write(f'[{logger}][WARNING] 2026-01-01 10:00:{second:02},500: {text}\n')
        check.check_new_lines()

    for second in (0, 10, 20):
        log(second, f'mcu: checksum: {second}')
        log(second, f'arduino: checksum: {second}')
    log(21, 'no master\nTraceback (most recent call last):', 'rospy.rosout')
    assert table.violated == []
    log(25, 'mcu: checksum: again')
    assert [required.violations for required in table.violated] == [1]
    log(26, 'exception in a callback\nTraceback (most recent call last):')
    assert len(table.violated) == 2


def test_terminal_output(tmp_path):
    table = Table()
    check = logs.LogCheck(str(tmp_path), table.row)
    out = tmp_path / 'bridge_1.out'
    out.write_text('\x1b[33m[WARN] [1.2]: mcu: the board is silent\x1b[0m\n[INFO] [1.2]: ready\n')
    check.check_new_lines()
    assert table.violated == []
    out.write_text(out.read_text() + 'Exception ignored\n')
    check.check_new_lines()
    assert [row.text for row in table.violated] == ['the terminal shows the log and nothing else']


def test_a_byte_that_is_moved_late_is_a_stall():
    one = machine.Machine()
    now = time.monotonic()
    one.moved(now - 10.0, now - 9.8)
    one.moved(now - 5.0, now - 4.95)
    assert one.stalled(now - 9.77, now - 9.0) and not one.stalled(now - 9.7, now - 4.0)
    assert one.late(now - 9.77, now - 9.0) == 0.0
    assert one.held(now - 9.7, now - 4.0) == pytest.approx(0.05)


def test_a_witness_that_is_suspended_is_late():
    one = machine.Machine()
    until(lambda: not one.stalled(time.monotonic(), time.monotonic()), 'it runs')
    began = time.monotonic()
    process = one._witnesses[0]._process
    process.send_signal(signal.SIGSTOP)
    time.sleep(0.2)
    process.send_signal(signal.SIGCONT)
    assert one.late(began, time.monotonic()) > 0.15


def test_a_write_is_noted_when_it_is_made(tmp_path):
    noted = writes.Writes()
    with open(tmp_path / 'device', 'wb', buffering=0) as file:
        noted.watch(file.name)
        file.write(b'x')
        until(noted.next)       # it runs
        began = time.monotonic()
        file.write(b'x')
        until(lambda: select.select([noted._times], [], [], 0)[0])
        known = time.monotonic()
        time.sleep(0.05)
        assert began <= noted.next()[0] <= known and noted.next() == []
        file.write(b'x')
        noted.watch(str(tmp_path))
        time.sleep(0.05)
        assert noted.next() == []       # it is of the device before


def test_bytes_are_noted_when_they_arrive_on_a_connection():
    noted = writes.Writes()
    near, far = socket.socketpair()
    other, *_ends = socket.socketpair()
    noted.watch_connection(near.fileno())
    times = []
    for number in range(1, 4):      # nothing is read
        began = time.monotonic()
        far.send(b'x')
        until(lambda: times.extend(noted.next()) or len(times) >= number)
        assert len(times) == number and began <= times[-1]
    noted.watch_connection(other.fileno())
    far.send(b'x')
    time.sleep(0.05)
    assert noted.next() == []       # it is of the connection before


def test_an_arrival_on_the_connection_before_does_not_count_on_one_with_its_descriptor():
    noted = writes.Writes()
    near, far = socket.socketpair()
    fd = near.fileno()
    noted.watch_connection(fd)
    far.send(b'x')
    until(lambda: select.select([noted._times], [], [], 0)[0])
    near.close()
    near, far = socket.socketpair()
    assert near.fileno() == fd
    began = time.monotonic()
    noted.watch_connection(fd)
    far.send(b'x')
    assert until(noted.next)[0] >= began


@pytest.mark.parametrize('found, times, not_arrived', [
    ([1.0, 2.0, 3.0], [2.0, 3.0], [1.0]), ([3.0], [3.0, 3.0], []), ([], [5.0, 5.0], [])])
def test_times_of_two_frames(line, found, times, not_arrived):
    """The first write has not arrived, or one is not known."""
    moved, noted = [], [found]
    line.on_moved = lambda *each: moved.append(each)
    line._writes.next = lambda seconds=0.0: noted.pop() if noted else []
    assert line.written(0, 4.0) == [] and line.written(2, 5.0) == times
    assert line.not_arrived == not_arrived and moved == [(times[0], 5.0)]
    assert line.written(1, 6.0) == [6.0]


def test_the_write_of_a_frame_may_be_noted_after_its_read(line):
    noted = [[time.monotonic() + 1.0], []]
    line._writes.next = lambda seconds=0.0: noted.pop()
    now = time.monotonic()
    assert line.written(1, now) == [now] and not noted


def test_every_broken_bridge_applies():
    found = broken.all_broken()
    assert len(found) >= 260 and all(each.files() for each in found)
    assert {each.requirement for each in found} <= {
        row.text for row in Table().rows}


def test_a_broken_bridge_that_no_longer_applies_is_an_error():
    for old in ('no such text', 'import'):
        each = broken.Broken('it', '', 'storm', '', [('link/link.py', old, '')])
        with pytest.raises(ValueError, match='times in link/link.py'):
            each.files()
