"""The thread that sends heartbeats: what cannot end it, and the gaps that it reports."""
from types import SimpleNamespace

import pytest
from fake_boards import until

from serial_communication.boards.arduino import heart as heart_module
from serial_communication.boards.arduino.heart import Heart


def make(work=lambda beat: beat, on_fault=None):
    return Heart('heart', 100.0, work, on_fault or (lambda text: None), lambda text: None)


@pytest.fixture
def heart():
    """One at 100 Hz whose every beat leaves; `faults` are the tracebacks that it has reported."""
    faults = []
    made = make(on_fault=faults.append)
    made.faults = faults
    made.start()
    yield made
    made.stop(1.0)


def test_a_nap_that_fails_does_not_end_it(heart, monkeypatch):
    """As time.sleep does with a negative argument."""
    def fail(_seconds):
        raise ValueError('sleep length must be non-negative')

    until(lambda: heart.beats)
    with monkeypatch.context() as patched:
        patched.setattr(heart_module, 'time', SimpleNamespace(
            sleep=fail, clock_gettime=heart_module.time.clock_gettime,
            CLOCK_BOOTTIME=heart_module.time.CLOCK_BOOTTIME))
        until(lambda: heart.faults)
        before = heart.beats
        until(lambda: heart.beats > before + 3)
    before = heart.beats
    until(lambda: heart.beats > before + 3)
    assert 'must be non-negative' in heart.faults[0]


# -- gaps between heartbeats ----------------------------------------------------------------------

def test_the_recent_gap_is_the_longest_since_it_was_last_asked_for():
    heart = make()
    assert heart.recent_gap(100.0) == 0.0, 'the port has not opened yet'
    for now in (100.0, 100.01, 100.11, 100.12):
        heart._count(now)
    assert heart.recent_gap(100.13) == pytest.approx(0.1)
    assert heart.recent_gap(100.13) == pytest.approx(0.01), 'that one is over'
    assert heart.max_gap == pytest.approx(0.1)


def test_a_gap_that_still_lasts_counts_and_once_more_as_it_ends():
    heart = make()
    heart._count(100.0)
    assert heart.recent_gap(105.0) == 5.0
    assert heart.recent_gap(106.0) == 6.0
    heart._count(106.5)
    assert heart.recent_gap(106.5) == 6.5
    assert heart.recent_gap(106.5) == 0.0


def test_without_any_heartbeat_the_gap_begins_as_the_port_opens():
    heart = make()
    heart.opened(100.0)
    assert heart.recent_gap(105.0) == 5.0
    heart.restart()
    assert heart.recent_gap(200.0) == 0.0, 'the port is closed'
