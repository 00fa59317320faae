"""The thread that sends heartbeats: it reports gaps."""
import pytest

from serial_communication.boards.arduino.heartbeat import HeartbeatThread


def make():
    return HeartbeatThread('heartbeat', 100.0, lambda due: due, lambda text: None, lambda: 100.0)


def test_a_fault_is_reported_and_the_next_step_is_due():
    faults = []
    thread = HeartbeatThread('heartbeat', 100.0, lambda due: 1 / 0, faults.append, lambda: 100.0)
    assert thread.step() == pytest.approx(100.01) and 'ZeroDivisionError' in faults[0]


# -- gaps between heartbeats ----------------------------------------------------------------------

def test_the_recent_gap_is_the_longest_since_the_last_call():
    thread = make()
    assert thread.recent_gap(100.0) == 0.0, 'the port was never open'
    for now in (100.0, 100.01, 100.11, 100.12):
        thread._count(now, now)
    assert thread.recent_gap(100.13) == pytest.approx(0.1)
    assert thread.recent_gap(100.13) == pytest.approx(0.01), 'that one is over'
    assert thread.max_gap == pytest.approx(0.1)


def test_a_gap_that_still_lasts_counts_and_again_when_it_ends():
    thread = make()
    thread._count(100.0, 100.0)
    assert thread.recent_gap(105.0) == 5.0
    assert thread.recent_gap(106.0) == 6.0
    thread._count(106.5, 106.5)
    assert thread.recent_gap(106.5) == 6.5
    assert thread.recent_gap(106.5) == 0.0


def test_the_time_that_sending_takes_belongs_to_the_gap():
    thread = make()
    for began, ended in ((100.0, 100.0), (100.01, 100.05), (100.05, 100.05)):
        thread._count(began, ended)
    assert thread.max_gap == pytest.approx(0.05)


def test_before_the_first_heartbeat_the_gap_counts_from_the_opening():
    thread = make()
    thread.port_opened(100.0)
    assert thread.recent_gap(105.0) == 5.0
    thread.port_closed()
    assert thread.recent_gap(200.0) == 0.0, 'the port is closed'
