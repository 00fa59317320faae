"""The example DiffDrive in its world: two wheels with mass, of which the left motor is weaker.

How its motors stop without heartbeats, or if the program hangs: test_motor_stop.py.
"""
import math
import struct

import pytest

from packets import HEARTBEAT, ODOM, cmd_vel

WHEELS = 'left', 'right'
TRACK, RADIUS = 0.16, 0.0325     # m


@pytest.fixture
def base(copy_of):
    base = copy_of('diff')
    yield base
    assert base.get('rx_overruns') == 0 and base.get('watchdog_resets') == 0


def of_both(base, name):
    return [base.get(f'{wheel}_{name}') for wheel in WHEELS]


def drive(base, ahead, turn=0.0, seconds=1.0):
    base.beat = cmd_vel(ahead, turn) + HEARTBEAT
    base.run(seconds)


def odometry(base):
    """The next message: x, y, yaw, ahead, turn."""
    return struct.unpack('<5f', base.next(ODOM)[0])


@pytest.mark.parametrize('ahead, turn, left, right', [
    (0.3, 0.0, 0.3, 0.3), (-0.2, 0.0, -0.2, -0.2), (0.0, 1.0, -0.08, 0.08),
    (0.2, -1.0, 0.28, 0.12),
    (2.0, 12.5, 1 / 6, 0.5),     # too fast: the same curve, more slowly
])
def test_each_wheel_has_its_speed_and_the_odometry_says_so(base, ahead, turn, left, right):
    drive(base, ahead, turn)
    turns = of_both(base, 'turns')
    base.forget()
    base.run(0.5)
    found = [(after - before) * 2 * math.pi * RADIUS / 0.5
             for before, after in zip(turns, of_both(base, 'turns'))]
    assert found == pytest.approx([left, right], abs=0.003)
    for data in base.seen(ODOM):
        told = struct.unpack('<5f', data)[3:]
        # An edge of an encoder is 0.1 rad/s.
        assert told == (pytest.approx((left + right) / 2, abs=0.03),
                        pytest.approx((right - left) / TRACK, abs=0.25))


def test_the_odometry_has_where_the_base_is(base):
    for ahead, turn, seconds in ((0.3, 0.0, 1), (0.2, 2.0, 2), (-0.2, 0.5, 1), (0.0, -3.0, 1),
                                 (0.0, 0.0, 0.5)):
        drive(base, ahead, turn, seconds)
    x, y, yaw, *speeds = odometry(base)
    assert math.hypot(x - base.get('x'), y - base.get('y')) < 0.002 and speeds == [0, 0]
    turned = math.remainder(yaw - math.radians(base.get('yaw')), 2 * math.pi)
    assert abs(math.degrees(turned)) < 0.3 and math.hypot(x, y) > 0.2


def test_a_bridge_is_off_before_its_direction_changes(base):
    for ahead in 0.3, -0.3, 0.3:
        drive(base, ahead)
    for wheel in WHEELS:
        inputs = [value for _, value in base.history(wheel + '_inputs')]
        assert inputs[::2] == [0] * len(inputs[::2]) and {1, 2} == set(inputs[1::2])


def off(base):
    """When each motor was turned off for the last time, in emulated seconds."""
    histories = [base.history(wheel + '_pwm') for wheel in WHEELS]
    assert [history[-1][1] for history in histories] == [0, 0]
    return [history[-1][0] for history in histories]


def test_a_command_of_0_turns_both_off_at_once(base):
    drive(base, 0.3)
    base.send(cmd_vel(0.0))
    began = base.now
    base.beat = HEARTBEAT
    base.run(0.5)
    assert all(each < began + 0.005 for each in off(base))


def test_motors_are_off_half_a_second_after_the_last_command(base):
    drive(base, 0.3)
    base.beat = HEARTBEAT
    began = base.now - 0.01
    base.run(1)
    assert all(began + 0.5 < each < began + 0.535 for each in off(base))
    drive(base, 0.2)
    assert min(of_both(base, 'speed')) == pytest.approx(0.2, abs=0.01)


@pytest.mark.parametrize('wheel', WHEELS)
@pytest.mark.parametrize('fault', ['held', 'encoder'])
def test_a_wheel_that_does_not_turn_stops_both_until_the_command_is_0(base, wheel, fault):
    """A blocked wheel, or an encoder whose cable is off."""
    drive(base, 0.2)
    base.set(**{f'{wheel}_{fault}': fault == 'held'})
    base.says(f'{wheel} wheel does not turn as it is driven')
    base.run(0.5)
    assert of_both(base, 'pwm') == [0, 0]
    base.set(**{f'{wheel}_{fault}': fault != 'held'})
    base.run(0.5)
    assert of_both(base, 'pwm') == [0, 0]
    drive(base, 0.0)
    drive(base, 0.2)
    assert of_both(base, 'speed') == pytest.approx([0.2, 0.2], abs=0.01)
