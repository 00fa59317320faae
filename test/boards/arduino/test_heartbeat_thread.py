"""The thread that sends heartbeats: it cannot be ended by a fault, and it reports gaps."""
import time
from types import SimpleNamespace

import pytest
from fake_boards import until

from serial_communication.boards.arduino import heartbeat as heartbeat_module
from serial_communication.boards.arduino.heartbeat import HeartbeatThread


def make(work=lambda due: due, on_fault=None):
    return HeartbeatThread('heartbeat', 100.0, work, on_fault or (lambda text: None))


@pytest.fixture
def thread():
    """A thread at 100 Hz that sends every heartbeat; `faults` has the tracebacks it reported."""
    faults = []
    made = make(on_fault=faults.append)
    made.faults = faults
    made.start()
    yield made
    made.stop(1.0)


def test_a_failed_sleep_does_not_end_the_thread(thread, monkeypatch):
    """time.sleep raises ValueError for a negative argument."""
    def fail(_seconds):
        raise ValueError('sleep length must be non-negative')

    until(lambda: thread.sent)
    with monkeypatch.context() as patched:
        patched.setattr(heartbeat_module, 'time', SimpleNamespace(
            sleep=fail, clock_gettime=heartbeat_module.time.clock_gettime,
            CLOCK_BOOTTIME=heartbeat_module.time.CLOCK_BOOTTIME))
        until(lambda: thread.faults)
        before = thread.sent
        until(lambda: thread.sent > before + 3)
    before = thread.sent
    until(lambda: thread.sent > before + 3)
    assert 'must be non-negative' in thread.faults[0]


def test_missed_heartbeats_are_not_sent_after_a_stall():
    times = []

    def work(due):
        if due:
            times.append(time.monotonic())
            if len(times) == 3:
                time.sleep(0.5)      # fifty periods
        return due

    thread = make(work)
    thread.start()
    until(lambda: len(times) >= 20)
    thread.stop(1.0)
    after = [moment for moment in times[3:] if moment < times[3] + 0.05]
    assert len(after) <= 9, 'five periods, and a few for the stall'


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
