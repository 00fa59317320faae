"""The firmware of the control board, ctrl_board: lift, gimbal, sensors; and the example Slave."""
import struct

import pytest
from by_definition import ENVIRONMENT, GIMBAL, LIFT

from packets import (DOOR, DOWN, FAILED, LEFT, MALFORMED, OK, PUMP, RIGHT, STOP, TANK, TILT_DOWN,
                     TILT_UP, UNSUPPORTED, UP, function, gimbal, lift, request)

ECHO, SYNC = 1, request(0)


def start(bus, order, axis='lift'):
    """Send an order, and wait until its axis moves."""
    moves = bus.get(axis + '_moves')
    bus.send(order)
    bus.until(lambda: bus.get(axis + '_moves') > moves)


def is_silent(bus, seconds=0.2):
    bus.run(seconds)
    return bus.received == []


def test_nothing_is_executed_before_sync(copy_of):
    bus = copy_of('ctrl')
    for order in lift(UP, 10), request(ECHO, 0, b'ping'), function(ENVIRONMENT):
        assert bus.call(order) == b'\xff\x10'
    assert bus.call(SYNC) == b'\0' and bus.call(request(ECHO, 0, b'ping')) == b'\x01ping'
    assert bus.get('lift_steps') == 0


def test_what_is_refused_moves_nothing(bus):
    for order, reply in (
            (function(0x77), UNSUPPORTED), (request(0x0A), UNSUPPORTED),
            (function(0xFF, 0), UNSUPPORTED),       # it announces nothing
            (function(LIFT, 2, 10), MALFORMED), (function(LIFT, 0), MALFORMED),
            (function(GIMBAL, 4, 10), MALFORMED), (function(GIMBAL, 0, 10, 0), MALFORMED),
            (lift(UP, 100)[:-1] + b'\0', b'\xff\x40'), (request(ECHO, 0, bytes(301)), b'\xff\x20'),
            (gimbal(TILT_UP, 91), FAILED), (gimbal(LEFT, 171), FAILED)):
        assert bus.call(order) == reply, order.hex()
        assert is_silent(bus)
    assert [bus.get(axis + '_steps') for axis in ('lift', 'pan', 'tilt')] == [0, 0, 0]


@pytest.mark.parametrize('order, axis, units, steps', [
    (lift(DOWN, 255), 'lift', -255, 25), (lift(UP, 1), 'lift', 1, 25),
    (gimbal(LEFT, 30), 'pan', 30, 10), (gimbal(RIGHT, 30), 'pan', -30, 10),
    (gimbal(TILT_UP, 30), 'tilt', 30, 10), (gimbal(TILT_DOWN, 90), 'tilt', -90, 10)])
def test_an_axis_moves_by_what_was_asked_once(bus, order, axis, units, steps):
    position = bus.get(axis + '_position')
    began = bus.now
    assert bus.call(order) == OK
    # The reply comes when the axis stands, and within the Master's five seconds.
    assert began < bus.get(axis + '_last_step') < bus.now < began + 4.5
    assert is_silent(bus)
    assert bus.get(axis + '_steps') == units * steps and bus.get(axis + '_moves') == 1
    assert bus.get(axis + '_position') == position + units      # no step was lost
    assert sum(bus.get(other + '_moves') for other in ('lift', 'pan', 'tilt')) == 1


def test_the_gimbal_keeps_its_count_through_a_reset_in_the_middle_of_a_move(booted):
    """Its limits of 170 degrees, from where it was at power-up, depend on the count."""
    for number in range(20):
        bus = booted('ctrl').copy()
        assert bus.call(SYNC) == b'\0'
        start(bus, gimbal(LEFT, 90), 'pan')
        bus.run(0.1 + 0.00037 * number)
        bus.ask('reset')
        bus.run(0.1)
        bus.forget()
        left, right = 170 - bus.get('pan_position'), 170 + bus.get('pan_position')
        assert bus.call(SYNC) == b'\0' and left < 169
        assert bus.call(gimbal(LEFT, int(left + 1.1))) == FAILED
        assert bus.call(gimbal(RIGHT, int(right + 1.1))) == FAILED
        start(bus, gimbal(LEFT, int(left - 0.1)), 'pan')
        bus.close()


@pytest.mark.parametrize('direction, end', [(UP, {'lift_top': 320}), (DOWN, {'lift_bottom': 280})])
def test_an_end_switch_stops_the_lift(bus, direction, end):
    bus.set(**end)
    assert bus.call(lift(direction, 100)) == FAILED
    assert 20 <= abs(bus.get('lift_position') - 300) < 20.5
    stopped = bus.get('lift_steps')
    assert bus.call(lift(direction, 1)) == FAILED and bus.get('lift_steps') == stopped
    assert bus.call(lift(1 - direction, 20)) == OK


@pytest.mark.parametrize('direction, wire', [(UP, 'lift_top_wire'), (DOWN, 'lift_bottom_wire')])
def test_a_broken_wire_of_an_end_switch_stops_the_lift_and_a_spike_does_not(bus, direction, wire):
    start(bus, lift(direction, 200))
    bus.set(lift_switch_spike=0.0005)
    assert is_silent(bus, 0.1)
    bus.set(**{wire: 0})
    broken = bus.now
    assert bus.reply() == FAILED and bus.get('lift_last_step') < broken + 0.003
    assert bus.call(lift(direction, 10)) == FAILED
    assert bus.call(lift(1 - direction, 10)) == OK


# Requests during a move


def test_stop_ends_the_move_at_once_and_what_waits_is_not_executed(bus):
    start(bus, lift(UP, 200))
    bus.run(0.5)
    began = bus.now
    bus.send(lift(UP, 200) + gimbal(LEFT, 90) + function(STOP) + request(ECHO, 0, b'after'))
    # The lift was carried out in part; then the stop; the orders between them get no reply.
    assert [bus.reply() for _ in range(3)] == [FAILED, OK, b'\x01after']
    assert bus.get('lift_last_step') < began + 0.005
    stopped = bus.get('lift_steps')
    assert is_silent(bus, 0.5)
    assert (bus.get('lift_moves'), bus.get('pan_steps'), bus.get('lift_steps')) == (1, 0, stopped)
    assert bus.call(lift(DOWN, 1)) == OK and bus.get('lift_steps') == stopped - 25


@pytest.mark.parametrize('count', [34, 80])
def test_fences_during_a_move_are_answered_after_it(bus, count):
    """A Master that has lost patience sends ECHO after ECHO, and needs the last one back."""
    start(bus, lift(UP, 60))
    for number in range(count):
        bus.send(request(ECHO, 0, b'n%03d' % number))
    assert bus.reply(5) == OK and bus.get('lift_steps') == 1500
    replies = [bus.reply()]
    while replies[-1] != b'\x01n%03d' % (count - 1):
        replies.append(bus.reply())
    assert replies == [b'\x01n%03d' % number for number in range(count - len(replies), count)]
    assert len(replies) == count or count > 34      # else the buffer overflowed
    assert is_silent(bus) and bus.get('lift_moves') == 1


def test_too_many_requests_during_a_move_are_executed_once_or_never(bus):
    start(bus, lift(UP, 100))
    bus.send(gimbal(LEFT, 1) * 100 + request(ECHO, 0, b'last'))     # a buffer has 306 bytes
    replies = [bus.reply(5)]
    while replies[-1] != b'\x01last':
        replies.append(bus.reply())
    assert set(replies[:-1]) == {OK}
    assert (bus.get('pan_steps'), bus.get('lift_steps')) == (10 * (len(replies) - 2), 2500)


def test_a_request_after_noise_is_executed_once_and_never_called_invalid(bus):
    """INVALID says that nothing is executed: a Master that reads it sends the request again."""
    for noise in (b'\xa5', b'\xa5\x02', b'\x5a\xff\xff', b'\xa5\0\0\0\0', b'\0\xff\x12'):
        pan = bus.get('pan_steps')
        assert bus.call(noise + gimbal(LEFT, 2)) == OK
        assert is_silent(bus) and bus.get('pan_steps') == pan + 20
    for delay in range(12):     # ms; the noise is called INVALID after 5, or never
        bus.send(bytes.fromhex('a500000001'))
        bus.run(0.001 * delay)
        bus.ask('stall 0.05')   # the program reads nothing meanwhile
        bus.send(gimbal(delay % 2, 1))
        bus.run(1)
        replies = [bytes((reply.type,)) + reply.data for reply in bus.received]
        assert replies == [OK] or delay > 4 and replies == [b'\xff\x40', OK]
        bus.forget()


# Measurements, faults of the I2C bus


def test_environment(bus):
    for smoke, temperature, humidity in ((350, 25.63, 48.12), (1023, -12.5, 100), (0, 0, 0)):
        bus.set(smoke=smoke, temperature=temperature, humidity=humidity)
        bus.run(0.6)    # two measurements
        for order in bytes.fromhex('a5025522d0'), function(ENVIRONMENT):
            reply = bus.call(order)
            assert reply[:1] == OK and struct.unpack('<HhH', reply[1:]) == pytest.approx(
                (smoke, temperature * 100, humidity * 100), abs=1)


@pytest.mark.parametrize('fault, value, cure', [
    ('sda_stuck', 1000, 5), ('scl_stuck', 1, 0), ('sht3x_present', 0, 1), ('sht3x_hangs', 1, 1)])
def test_a_fault_of_the_sensor_or_its_bus_fails_nothing_else(bus, fault, value, cure):
    def measures():
        return bus.call(function(ENVIRONMENT))[:1] == OK
    bus.until(measures)
    bus.set(**{fault: value})
    if fault != 'sht3x_hangs':      # which is reset at once
        bus.until(lambda: not measures())
    for number in range(20):
        began = bus.now
        assert bus.call(request(ECHO, 0, b'%d' % number)) == b'\x01%d' % number
        assert bus.now - began < 0.02
    bus.set(**{fault: cure})
    bus.until(measures)


# Custom functions


def test_custom_functions(copy_of):
    bus = copy_of('ctrl', 'ctrl_board_custom.elf')
    assert bus.call(SYNC) == b'\0'
    for on in 1, 0:
        assert bus.call(function(PUMP, on)) == OK and bus.get('pump') == on
    assert bus.call(function(PUMP)) == MALFORMED
    for raw in 0, 300, 1023:
        bus.set(tank=raw)
        assert bus.call(function(TANK)) == OK + struct.pack('<H', raw * 10)


def test_the_door_of_the_example_is_stopped(copy_of):
    bus = copy_of('ctrl', 'Slave.elf')
    assert bus.call(SYNC) == b'\0'
    assert bus.call(function(DOOR, 2)) == MALFORMED and bus.get('door') == 0
    assert bus.call(function(DOOR, 1)) == OK
    (on, _), (off, _) = bus.history('door')[-2:]
    assert off - on == pytest.approx(4, abs=0.1)
    bus.send(function(DOOR, 0))
    bus.until(lambda: bus.get('door'))
    bus.send(function(STOP))
    assert [bus.reply(), bus.reply()] == [FAILED, OK] and bus.get('door') == 0
