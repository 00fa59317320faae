"""When SPEED 0 has to be sent to the motor; the tests set the time."""
import pytest

from serial_communication.boards.arduino.motor import Motor, Stop


@pytest.fixture
def motor():
    """A stopped motor: SPEED 0 was sent, and all its repetitions."""
    made = Motor(0.5, 0.0)
    made.sent(0, 0.0)
    repetitions(made, 0.0, 2.0)
    made.awake(100.0)
    return made


def repetitions(motor, begin, end):
    """The times, since `begin`, at which SPEED 0 is due if that is checked at 100 Hz to `end`."""
    sent = []
    for step in range(int((end - begin) * 100) + 1):
        now = begin + step / 100
        motor.awake(now)
        if motor.due(now):
            motor.sent(0, now)
            sent.append(round(now - begin, 3))
    return sent


def test_the_speed_is_unknown_until_the_first_speed_0():
    motor = Motor(0.5, 0.0)
    assert motor.speed_unknown and motor.moving and motor.due(0.0) is Stop.UNKNOWN_SPEED
    motor.sent(0, 0.0)
    assert not motor.speed_unknown and not motor.moving and motor.due(0.01) is None


def test_a_stop_is_repeated_every_50_ms_for_a_second(motor):
    motor.sent(500, 100.0)
    motor.sent(0, 100.1)
    assert repetitions(motor, 100.1, 103.0) == pytest.approx(
        [number * 0.05 for number in range(1, 21)])


def test_speed_0_is_not_repeated_if_the_motor_has_stopped(motor):
    motor.sent(0, 100.0)
    assert repetitions(motor, 100.0, 102.0) == []


def test_another_speed_0_neither_ends_nor_extends_the_repetitions(motor):
    motor.sent(500, 100.0)
    motor.sent(0, 100.0)
    motor.sent(0, 100.52)
    times = repetitions(motor, 100.52, 103.0)
    assert times[0] == pytest.approx(0.05) and times[-1] <= 0.5


def test_another_speed_ends_the_repetitions_and_a_calibration_holds_them_back(motor):
    motor.sent(500, 100.0)
    motor.sent(0, 100.0)
    motor.sent(1, 100.1)
    assert motor.due(100.2) is None
    motor.sent(0, 100.2)
    assert motor.due(100.3, board_reads=False) is None and motor.due(100.3) is Stop.REPEATED


def test_repetitions_held_back_are_not_made_up_for(motor):
    motor.sent(500, 100.0)
    motor.sent(0, 100.0)
    assert motor.due(100.1) is Stop.REPEATED
    assert motor.due(103.0) is None


def test_speed_0_is_due_after_the_speed_timeout(motor):
    motor.sent(500, 100.0)
    motor.sent(400, 100.4)
    assert motor.due(100.89) is None and motor.due(100.91) is Stop.TIMED_OUT
    motor.sent(0, 100.91)
    assert motor.due(100.96) is Stop.REPEATED


def test_with_a_speed_timeout_of_0_no_speed_times_out():
    motor = Motor(0.0, 0.0)
    motor.sent(0, 0.0)
    motor.sent(500, 0.0)
    assert motor.due(1e6) is None


def test_a_stop_of_an_unknown_speed_is_repeated(motor):
    motor.forget_speed()
    assert motor.due(100.0) is Stop.UNKNOWN_SPEED
    motor.sent(0, 100.0)
    assert len(repetitions(motor, 100.0, 102.0)) == 20


def test_missed_repetitions_do_not_follow_all_at_once(motor):
    motor.sent(500, 100.0)
    motor.sent(0, 100.0)
    assert motor.due(100.4) is Stop.REPEATED
    motor.sent(0, 100.4)
    assert motor.due(100.42) is None and motor.due(100.45) is Stop.REPEATED


def test_a_stall_is_reported_once_and_commands_are_ignored_for_a_while(motor):
    assert motor.detect_stall(100.5) is None
    assert motor.detect_stall(105.0) == pytest.approx(5.0)
    assert motor.due(105.0) is Stop.UNKNOWN_SPEED
    assert motor.ignores_commands(105.0) and motor.ignores_commands(105.4)
    assert motor.detect_stall(105.0) is None
    assert not motor.ignores_commands(105.6)


@pytest.mark.parametrize('speed_timeout', [0.0, 0.01, 0.5, 10.0])
def test_a_stall_begins_at_half_a_second_for_any_speed_timeout(speed_timeout):
    motor = Motor(speed_timeout, 100.0)
    assert motor.detect_stall(100.49) is None and motor.detect_stall(100.51) is not None
    assert motor.due(100.51) is Stop.UNKNOWN_SPEED and motor.ignores_commands(100.51)


def test_a_stall_of_the_receiving_threads_alone_is_a_stall(motor):
    motor.sent(500, 100.0)
    motor.awake(100.0)
    reported, reported_at, sent = [], [], []
    for step in range(1, 401):      # the receiving threads run again after 3 s
        now = 100.0 + step / 100
        stalled_for = motor.detect_stall(now, 100.0 if now < 103.0 else now)
        if stalled_for is not None:
            reported.append(stalled_for)
            reported_at.append(now)
        motor.awake(now)
        if motor.due(now):
            motor.sent(0, now)
            sent.append(now)
        if abs(now - 100.5) > 0.02 and abs(now - 103.5) > 0.02:
            assert motor.ignores_commands(now) == (100.5 < now < 103.5)
    assert reported == [pytest.approx(0.51, abs=0.011)]
    assert reported_at[0] in sent and len(sent) <= 23, 'it is repeated like any stop'
