"""The campaign's rows, lines and boards."""
import os
import struct
import time

import pytest
from waiting import until

import by_definition as codec
from campaign.boards import (Answer, BusBoard, Car, Request, Sensors, imu_of, known, range_of,
                             reply)
from campaign.lines import Clock, Line, NetworkLine
from campaign.logs import LogWatch, cause_of
from campaign.rows import Table


@pytest.fixture
def line(tmp_path):
    line = Line(str(tmp_path / 'port'))
    yield line
    if line.plugged:
        line.unplug()


def opened(line):
    return os.open(line.port, os.O_RDWR | os.O_NOCTTY)


def test_table():
    table = Table()
    row = table.row('motor', 'it stops')
    row.check(True, '')
    assert table.violated == [] and table.row('motor', 'it stops') is row
    row.at_most(3.0, 2.0, 's', 'too late')
    row.undecided += 1
    table.row('motor', 'seen', counted=True).tries += 1
    table.row('bus', 'never tried')
    assert table.violated == [row] and row.worst_case == '3 s'
    assert table.summary() == '1 promises, 1 violated, 1 tries not decided'
    text = table.render()
    assert 'too late: 3 s, may be 2 s' in text and 'never tried' not in text
    assert [line.split() for line in text.splitlines() if 'it stops' in line][0] == [
        'motor', 'it', 'stops', '2', '1', '1', '3', 's']


def test_line_comes_back_as_another_device(line):
    cuts, before = [], os.path.realpath(line.port)
    line.cut = lambda: cuts.append(1)
    line.unplug()
    assert not os.path.exists(line.port) and not line.write(b'x') and cuts == [1]
    line.plug(another_name=True)
    assert os.path.realpath(line.port) != before


def test_frozen_line_has_no_room_and_hands_on_what_it_held(line):
    came = []
    line.take = lambda data, now: came.append(data)
    end = os.open(line.port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    os.write(end, b'before')
    line.freeze()
    assert b''.join(came) == b'before'
    with pytest.raises(BlockingIOError):
        os.write(end, b'after')
    line.thaw()
    until(lambda: len(b''.join(came)) > 4000)
    assert b'after' not in b''.join(came)
    os.close(end)


def test_network_forgets_a_connection(tmp_path):
    import socket
    line, came = NetworkLine(str(tmp_path / 'unused')), []
    line.take = lambda data, now: came.append(data)
    address = '127.0.0.1', int(line.port.rpartition(':')[2])
    with socket.create_connection(address) as first:
        first.sendall(b'one')
        until(lambda: came == [b'one'])
        line.vanish()
        first.sendall(b'lost')
        with socket.create_connection(address) as second:
            second.sendall(b'two')
            until(lambda: came == [b'one', b'two'])


def test_car_knows_its_packets_by_heartbeats(line):
    car = Car(line)
    end = opened(line)
    beat = codec.arduino_packet(codec.HEARTBEAT)
    os.write(end, codec.arduino_packet(codec.SPEED, b'\0\0') + beat * 3
             + codec.arduino_packet(codec.SPEED, struct.pack('<h', -7)))
    until(lambda: len(car.packets) == 2)
    assert car.first[0].stops and car.beat == 3 and car.packets[1].beat == 3
    assert car.zero_after(car.packets[0]) is None and car.packets[1].since(car.packets[0]) == 0.03
    assert car.commands(codec.SPEED) == [0, -7] and car.packet(codec.SPEED, -7)
    line.unplug()
    assert car.connection == 1 and car.beat == 0 and car.ended == [3]
    os.close(end)


def test_boards_know_what_is_to_be_published(line):
    car, sensors = Car(line), Sensors(line)
    car.measure()
    assert [one.topic for one in car.sent] == ['~ticks', '~steering_angle', '~voltage', '~counter',
                                               '~imu', '~imu/temperature']
    assert [one.key for one in car.sent[:4]] == [1, 1, 1, 1] and car.sent[4].key == imu_of(1)[:10]
    sensors.measure()
    assert [one.key for one in sensors.sent] == [(1, 1, 7, (37, -4499, -1)), 'near', 'near']
    assert known((1, -32768, 2)) is known((None, 1, 2)) is None
    assert [range_of(value) for value in (65535, 29, 30, 2000, 2001)] == [
        'timed out', 'near', 30, 2000, 'far']


def test_bus_board_keeps_the_order_of_its_line(line):
    """What is late, or comes twice, makes all behind it late."""
    board = BusBoard(line, Clock())
    ok = reply(codec.OK)
    board.rule = lambda request: Answer([(0, ok), (0.05, ok)], True)
    end = opened(line)
    os.write(end, codec.bus_frame(b'\x55\x20', b'\0\1') + codec.bus_frame(b'\1\0', b'nonce'))
    wanted, came = ok + ok + reply(codec.ECHO, b'nonce'), b''
    while len(came) < len(wanted):
        came += os.read(end, 100)
    assert came == wanted
    assert board.executed[0x20, b'\0\1'] == 1
    assert [request.key for request in board.requests] == [(0x20, b'\0\1'), (0, b'nonce')]
    assert isinstance(board.requests[0], Request)
    os.close(end)


def test_clock_keeps_its_times():
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
    assert cause_of(text) == cause


def test_log_lines(tmp_path):
    table = Table()
    watch = LogWatch(str(tmp_path), table.row)

    def say(second, text, logger='rosout'):
        with open(str(tmp_path / 'bridge_1.log'), 'a') as file:
            file.write(f'[{logger}][WARNING] 2026-01-01 10:00:{second:02},500: {text}\n')
        watch.look()

    for second in (0, 10, 20):
        say(second, f'mcu: checksum: {second}')
        say(second, f'arduino: checksum: {second}')
    say(21, 'no master\nTraceback (most recent call last):', 'rospy.rosout')
    assert table.violated == []
    say(25, 'mcu: checksum: again')
    assert [row.violations for row in table.violated] == [1]
    say(26, 'bad callback\nTraceback (most recent call last):')
    assert len(table.violated) == 2
