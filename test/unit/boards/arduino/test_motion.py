"""When the zero of a motion has to be sent; the tests set the time."""
import pytest

from serial_communication.boards.arduino.motion import Motion


@pytest.fixture
def motor():
    """A stopped motor: SPEED 0 was sent, and all its repetitions."""
    made = Motion(0, 0.5)
    made.sent(0, 0.0)
    repetitions(made, 0.0, 2.0)
    return made


def repetitions(motor, begin, end):
    """The times, since `begin`, at which SPEED 0 is due if that is checked at 100 Hz to `end`."""
    sent = []
    for step in range(int((end - begin) * 100) + 1):
        now = begin + step / 100
        if motor.due(now):
            motor.sent(0, now)
            sent.append(round(now - begin, 3))
    return sent


def test_the_speed_is_unknown_until_the_first_speed_0():
    motor = Motion(0, 0.5)
    assert motor.is_unknown and motor.moves and motor.due(0.0)
    motor.sent(0, 0.0)
    assert not motor.is_unknown and not motor.moves and not motor.due(0.01)


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
    assert not motor.due(100.2)
    motor.sent(0, 100.2)
    assert not motor.due(100.3, board_reads=False) and motor.due(100.3)


def test_repetitions_held_back_are_not_made_up_for(motor):
    motor.sent(500, 100.0)
    motor.sent(0, 100.0)
    assert motor.due(100.1)
    assert not motor.due(103.0)


def test_speed_0_is_due_after_the_speed_timeout(motor):
    motor.sent(500, 100.0)
    motor.sent(400, 100.4)
    assert not motor.due(100.89) and motor.due(100.91)
    motor.sent(0, 100.91)
    assert motor.due(100.96)


def test_with_a_speed_timeout_of_0_no_speed_times_out():
    motor = Motion(0, 0.0)
    motor.sent(0, 0.0)
    motor.sent(500, 0.0)
    assert not motor.due(1e6)


def test_a_stop_of_an_unknown_speed_is_repeated(motor):
    motor.forget()
    assert motor.due(100.0)
    motor.sent(0, 100.0)
    assert len(repetitions(motor, 100.0, 102.0)) == 20


def test_missed_repetitions_do_not_follow_all_at_once(motor):
    motor.sent(500, 100.0)
    motor.sent(0, 100.0)
    assert motor.due(100.4)
    motor.sent(0, 100.4)
    assert not motor.due(100.42) and motor.due(100.45)
