"""The thread that sends heartbeats: it cannot be ended by a fault, and it reports gaps."""
import pytest
from fake_boards import until

from serial_communication.boards.arduino import heartbeat as heartbeat_module
from serial_communication.boards.arduino.heartbeat import HeartbeatThread


def make(work=lambda due: due, on_fault=None):
    return HeartbeatThread('heartbeat', 100.0, work, on_fault or (lambda text: None))


def test_a_failed_sleep_does_not_end_the_thread(monkeypatch):
    """time.sleep raises ValueError for a negative argument."""
    faults = []
    thread = make(on_fault=faults.append)
    monkeypatch.setattr(heartbeat_module, '_LONGEST_SLEEP', -1.0)
    thread.start()
    until(lambda: faults and thread.sent > 3)
    thread.stop(1.0)
    assert 'must be non-negative' in faults[0]


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
