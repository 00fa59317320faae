"""The campaign's table, lines, boards and logs."""
import os
import struct
import time

import pytest
from waiting import until

import by_definition as codec
from campaign import logs
from campaign.boards import (BusBoard, Car, Reaction, Request, Sensors, angles_key, imu_values,
                             range_key, reply_frame)
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


def test_table():
    table = Table()
    required = table.require('motor', 'it stops')
    required.check(True, '')
    assert table.violated == [] and table.require('motor', 'it stops') is required
    required.at_most(3.0, 2.0, 's', 'too late')
    required.undecided += 1
    table.require('motor', 'events', counted=True).checks += 1
    table.require('bus', 'not checked')
    assert table.violated == [required] and required.worst_case == '3 s'
    assert table.summary() == '1 requirements, 1 violated, 1 checks not decided'
    text = table.render()
    assert 'too late: 3 s, limit 2 s' in text and 'not checked' not in text
    assert [line.split() for line in text.splitlines() if 'it stops' in line][0] == [
        'motor', 'it', 'stops', '2', '1', '1', '3', 's']


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
    car = Car(line)
    end = opened(line)
    heartbeat = codec.arduino_packet(codec.HEARTBEAT)
    os.write(end, codec.arduino_packet(codec.SPEED, b'\0\0') + heartbeat * 3
             + codec.arduino_packet(codec.SPEED, struct.pack('<h', -7)))
    until(lambda: len(car.packets) == 2)
    assert car.first[0].is_stop and car.heartbeats == 3 and car.packets[1].heartbeats == 3
    assert car.stop_after(car.packets[0]) is None and car.packets[1].since(car.packets[0]) == 0.03
    assert car.commands(codec.SPEED) == [0, -7] and car.packet(codec.SPEED, -7)
    line.unplug()
    assert car.connection == 1 and car.heartbeats == 0 and car.ended == [3]
    os.close(end)


def test_boards_record_the_values_that_they_send(line):
    car, sensors = Car(line), Sensors(line)
    car.measure()
    assert [each.topic for each in car.sent] == [
        '~ticks', '~steering_angle', '~voltage', '~counter', '~imu', '~imu/temperature']
    assert [each.key for each in car.sent[:5]] == [1, 1, 1, 1, imu_values(1)[:10]]
    sensors.measure()
    assert [each.key for each in sensors.sent] == [(1, 1, 7, (37, -4499, -1)), 'near', 'near']
    assert angles_key((1, -32768, 2)) is angles_key((None, 1, 2)) is None
    assert [range_key(value) for value in (65535, 29, 30, 2000, 2001)] == [
        'timed out', 'near', 30, 2000, 'far']


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
    check = logs.LogCheck(str(tmp_path), table.require)

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


def test_old_late_wake_ups_are_forgotten(tmp_path, monkeypatch):
    monkeypatch.setattr(logs, '_LATE_KEPT', 3)
    path = tmp_path / 'sleeper.out'
    path.write_text('1.0 0.9\n2.0 0.2\n3.0 0.1\n4.')
    wake_ups = logs.LateWakeUps(str(path))
    assert [wake_ups.longest(since) for since in (0.0, 1.5, 3.5)] == [0.9, 0.2, 0.0]
    path.write_text(path.read_text() + '0 0.3\n')
    assert [wake_ups.longest(since) for since in (0.0, 4.5)] == [0.3, 0.0]
