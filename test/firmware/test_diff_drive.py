"""The example DiffDrive in its world: two wheels with mass, of which the left motor is weaker."""
import math

import pytest

from board_ends import ERROR
from driven_base import base_end, cmd_vel
from waiting import again_if_stalled

WHEELS = 'left', 'right'
TRACK, RADIUS = 0.16, 0.0325     # m


@pytest.fixture
def base(firmware_build):
    with base_end(firmware_build) as base:
        yield base
        assert base.board.get('rx_overruns') == 0 and base.board.get('watchdog_resets') == 0


def speeds(base):
    return [base.board.get(wheel + '_speed') for wheel in WHEELS]


def duties(base):
    return [base.board.get(wheel + '_pwm') for wheel in WHEELS]


def drives_at(base, ahead, turn, left, right):
    """Drive until the wheels have had these speeds for 0.3 s, and each message of odometry so.

    Speeds are turns in a time of the board's world: how often this computer looks has no influence.
    """
    board, wanted = base.board, (left, right)
    snapshot = ('time', 'left_turns', 'right_turns')
    before = board.at_once(*snapshot)
    told = []

    def steady():
        nonlocal before
        told.extend(base.new)
        now = board.at_once(*snapshot)
        seconds = now[0] - before[0]
        if seconds < 0.3:
            return False
        found = [(after - earlier) * 2 * math.pi * RADIUS / seconds
                 for earlier, after in zip(before[1:], now[1:])]
        agreed = len(told) > 10 and all(      # one edge of an encoder is 0.1 rad/s
            each[3] == pytest.approx((left + right) / 2, abs=0.03)
            and each[4] == pytest.approx((right - left) / TRACK, abs=0.25) for each in told)
        before = now
        told.clear()
        return agreed and found == pytest.approx(wanted, abs=0.003)
    base.drive_until(steady, ahead, turn, seconds=20)


@pytest.mark.parametrize('ahead, turn, left, right', [
    (0.3, 0.0, 0.3, 0.3), (-0.2, 0.0, -0.2, -0.2), (0.0, 1.0, -0.08, 0.08),
    (0.2, -1.0, 0.28, 0.12),
    (2.0, 12.5, 1 / 6, 0.5),     # too fast: the same curve, more slowly
])
def test_each_wheel_has_its_speed(base, ahead, turn, left, right):
    drives_at(base, ahead, turn, left, right)


def test_the_odometry_of_a_square_is_where_the_base_is(base):
    base.drive_square(0.5)
    true, believed = base.truth(), base.believed()
    off = math.hypot(true.x - believed.x, true.y - believed.y)
    turned = math.degrees(math.remainder(true.yaw - believed.yaw, 2 * math.pi))
    home = math.hypot(true.x, true.y)
    print('after a square of 4 x 0.5 m: odometry off by %.2f mm and %.3f degrees, the base %.1f mm '
          'from its start' % (off * 1000, turned, home * 1000))
    assert off < 0.001 and abs(turned) < 0.2
    assert true.yaw > 6.2     # how well it closes, depends on how soon this computer answers
    turns = sum(base.board.get(wheel + '_turns') for wheel in WHEELS) / 2
    assert turns * 2 * math.pi * RADIUS > 1.99


def off_after(base, stop):
    """Drive, call stop(), and return when both motors were off, in emulated seconds."""
    base.drive_until(lambda: all(duty > 50 for duty in duties(base)), 0.3)
    stop()
    histories = [base.board.history(wheel + '_pwm') for wheel in WHEELS]
    assert [history[-1][1] for history in histories] == [0, 0]
    return [history[-1][0] for history in histories]


def last_command(base, ahead):
    """Send a command, then heartbeats for 0.8 s; return between which times it has arrived."""
    board = base.board
    began, number, arrived = board.time, base.write(cmd_vel(ahead, 0.0)), []

    def over():
        base.beat()
        if not arrived and board.get('rx_bytes') >= number:
            arrived.append(board.time)
        return arrived and board.time > arrived[0] + 0.8
    base.beat_until(over, 3)
    return began, arrived[0]


def test_motors_are_off_30_ms_after_the_last_heartbeat(base):
    board = base.board

    def silence():
        board.wait_until(lambda: board.time - board.get('last_rx_time') > 0.1, 2)
    for off in off_after(base, silence):
        assert 0.029 <= off - board.get('last_rx_time') <= 0.033
    # Heartbeats alone do not turn them on again.
    end = board.time + 0.3
    base.beat_until(lambda: base.beat() or board.time > end, 2)
    assert duties(base) == [0, 0]
    board.wait_until(lambda: max(map(abs, speeds(base))) < 1e-3, 2)
    drives_at(base, 0.2, 0.0, 0.2, 0.2)


def test_motors_are_off_half_a_second_after_the_last_command(base):
    def measured():
        arrived = []
        off = off_after(base, lambda: arrived.extend(last_command(base, 0.3)))
        # A stall costs heartbeats, and then they are off too early.
        return all(arrived[0] + 0.5 < each < arrived[1] + 0.525 for each in off)
    assert again_if_stalled(measured)


def test_a_command_of_0_turns_both_off_at_once(base):
    arrived = []
    off = off_after(base, lambda: arrived.extend(last_command(base, 0.0)))
    assert all(each < arrived[1] + 0.005 for each in off)


@pytest.mark.parametrize('wheel', WHEELS)
@pytest.mark.parametrize('fault', ['held', 'encoder'])
def test_a_wheel_that_does_not_turn_stops_both_until_the_command_is_0(base, wheel, fault):
    """A blocked wheel, or an encoder whose cable is off."""
    board = base.board
    drives_at(base, 0.2, 0.0, 0.2, 0.2)
    board.set(f'{wheel}_{fault}', fault == 'held')
    base.drive_until(lambda: [text for kind, text in base.texts() if kind == ERROR], 0.2)
    assert base.texts()[-1] == (ERROR, f'{wheel} wheel does not turn as it is driven')
    end = board.time + 1
    base.drive_until(lambda: board.time > end, 0.2)
    assert duties(base) == [0, 0]
    board.set(f'{wheel}_{fault}', fault != 'held')
    base.stand()
    drives_at(base, 0.2, 0.0, 0.2, 0.2)
