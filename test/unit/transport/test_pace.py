"""Deadlines and the rate limit, with times given by the test."""
from serial_communication.transport.pace import Allowance, Every


def test_a_full_burst_is_allowed_and_then_one_per_period():
    allowance = Allowance(3, 2.0)
    assert [allowance.take(100.0) for _ in range(5)] == [True, True, True, False, False]
    assert not allowance.take(100.25)
    assert allowance.take(100.5) and not allowance.take(100.5), 'one each half second, exactly'


def test_unused_allowance_adds_up_to_one_burst_at_most():
    allowance = Allowance(2, 1.0)
    assert [allowance.take(50.0) for _ in range(3)] == [True, True, False]
    assert [allowance.take(1000.0) for _ in range(3)] == [True, True, False]


def test_deadlines_do_not_drift_and_a_stall_causes_no_burst():
    pace = Every(0.5, 10.0)
    assert not pace.passed(10.4) and pace.passed(10.6) and pace.due == 11.0
    assert pace.passed(20.2) and pace.due == 20.7
    assert not pace.passed(20.6) and pace.passed(20.7) and pace.due == 21.2
