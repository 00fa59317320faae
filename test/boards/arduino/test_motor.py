"""When the motor must be told SPEED 0: rules with a clock of the test's own."""
import pytest

from serial_communication.boards.arduino.motor import Motor, Stop


@pytest.fixture
def motor():
    """One that stands: its SPEED 0 was sent, and repeated to the end."""
    made = Motor(0.5, 0.0)
    made.sent(0, 0.0)
    repetitions(made, 0.0, 2.0)
    made.awake(100.0)
    return made


def repetitions(motor, begin, end):
    """The times at which SPEED 0 is sent from `begin` to `end` by a heart that beats at 100 Hz."""
    sent = []
    for beat in range(int((end - begin) * 100) + 1):
        now = begin + beat / 100
        motor.awake(now)
        if motor.due(now):
            motor.sent(0, now)
            sent.append(round(now - begin, 3))
    return sent


def test_a_new_one_is_in_doubt_until_speed_0_is_sent():
    motor = Motor(0.5, 0.0)
    assert motor.in_doubt and motor.moving and motor.due(0.0) is Stop.IN_DOUBT
    motor.sent(0, 0.0)
    assert not motor.in_doubt and not motor.moving and motor.due(0.01) is None


def test_a_stop_is_repeated_every_50_ms_for_a_second(motor):
    motor.sent(500, 100.0)
    motor.sent(0, 100.1)
    assert repetitions(motor, 100.1, 103.0) == pytest.approx(
        [number * 0.05 for number in range(1, 21)])


def test_a_speed_0_that_ends_nothing_is_not_repeated(motor):
    motor.sent(0, 100.0)
    assert repetitions(motor, 100.0, 102.0) == []


def test_another_speed_0_does_not_end_the_repetitions_nor_prolong_them(motor):
    motor.sent(500, 100.0)
    motor.sent(0, 100.0)
    motor.sent(0, 100.52)
    times = repetitions(motor, 100.52, 103.0)
    assert times[0] == pytest.approx(0.05) and times[-1] <= 0.5


def test_a_speed_ends_them_and_a_calibration_holds_them_back(motor):
    motor.sent(500, 100.0)
    motor.sent(0, 100.0)
    motor.sent(1, 100.1)
    assert motor.due(100.2) is None
    motor.sent(0, 100.2)
    assert motor.due(100.3, board_reads=False) is None and motor.due(100.3) is Stop.REPEATED


def test_repetitions_that_were_held_back_are_not_sent_later(motor):
    motor.sent(500, 100.0)
    motor.sent(0, 100.0)
    assert motor.due(100.1) is Stop.REPEATED
    assert motor.due(103.0) is None


def test_a_speed_times_out(motor):
    motor.sent(500, 100.0)
    motor.sent(400, 100.4)
    assert motor.due(100.89) is None and motor.due(100.91) is Stop.TIMED_OUT
    motor.sent(0, 100.91)
    assert motor.due(100.96) is Stop.REPEATED


def test_a_timeout_of_0_is_never():
    motor = Motor(0.0, 0.0)
    motor.sent(0, 0.0)
    motor.sent(500, 0.0)
    assert motor.due(1e6) is None


def test_doubt_makes_any_stop_begin_again(motor):
    motor.expect_any_speed()
    assert motor.due(100.0) is Stop.IN_DOUBT
    motor.sent(0, 100.0)
    assert len(repetitions(motor, 100.0, 102.0)) == 20


def test_repetitions_that_a_busy_computer_missed_do_not_follow_all_at_once(motor):
    motor.sent(500, 100.0)
    motor.sent(0, 100.0)
    assert motor.due(100.4) is Stop.REPEATED
    motor.sent(0, 100.4)
    assert motor.due(100.42) is None and motor.due(100.45) is Stop.REPEATED


def test_a_stall_is_noticed_once_and_commands_are_ignored_for_a_while(motor):
    assert motor.noticed_stall(100.5) is None
    assert motor.noticed_stall(105.0) == pytest.approx(5.0)
    assert motor.due(105.0) is Stop.IN_DOUBT
    assert motor.ignores_commands(105.0) and motor.ignores_commands(105.4)
    assert motor.noticed_stall(105.0) is None
    assert not motor.ignores_commands(105.6)


@pytest.mark.parametrize('speed_timeout', [0.0, 0.01, 0.5, 10.0])
def test_a_stall_is_longer_than_half_a_second_whatever_the_speed_timeout_is(speed_timeout):
    motor = Motor(speed_timeout, 100.0)
    assert motor.noticed_stall(100.49) is None and motor.noticed_stall(100.51) is not None
    assert motor.due(100.51) is Stop.IN_DOUBT and motor.ignores_commands(100.51)


def test_threads_that_receive_nothing_are_a_stall_though_the_heart_is_at_work(motor):
    motor.sent(500, 100.0)
    motor.awake(100.0)
    told, told_at, sent = [], [], []
    for beat in range(1, 401):      # the threads that receive are at work again after 3 s
        now = 100.0 + beat / 100
        stalled_for = motor.noticed_stall(now, 100.0 if now < 103.0 else now)
        if stalled_for is not None:
            told.append(stalled_for)
            told_at.append(now)
        motor.awake(now)
        if motor.due(now):
            motor.sent(0, now)
            sent.append(now)
        if abs(now - 100.5) > 0.02 and abs(now - 103.5) > 0.02:
            assert motor.ignores_commands(now) == (100.5 < now < 103.5)
    assert told == [pytest.approx(0.51, abs=0.011)]
    assert told_at[0] in sent and len(sent) <= 23, 'as any stop is repeated'


def test_where_there_is_nothing_to_receive_only_the_heart_counts(motor):
    assert motor.noticed_stall(100.4, float('inf')) is None
    assert motor.noticed_stall(100.6, float('inf')) is not None
