"""How often, and how promptly: with a clock of the test's own."""
from serial_communication.transport.pace import Allowance, Every


def test_a_burst_is_as_long_as_it_says_and_one_more_comes_with_its_time():
    allowance = Allowance(3, 2.0)
    assert [allowance.take(100.0) for _ in range(5)] == [True, True, True, False, False]
    assert not allowance.take(100.25)
    assert allowance.take(100.5) and not allowance.take(100.5), 'one each half second, exactly'


def test_what_was_not_taken_adds_up_to_a_burst_and_no_further():
    allowance = Allowance(2, 1.0)
    assert [allowance.take(50.0) for _ in range(3)] == [True, True, False]
    assert [allowance.take(1000.0) for _ in range(3)] == [True, True, False]


def test_deadlines_do_not_drift_and_do_not_come_in_a_burst_after_a_stall():
    pace = Every(0.5, 10.0)
    assert not pace.passed(10.4) and pace.passed(10.6) and pace.due == 11.0
    assert pace.passed(20.2) and pace.due == 20.7
    assert not pace.passed(20.6) and pace.passed(20.7) and pace.due == 21.2
