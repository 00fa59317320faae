"""The thread that sends heartbeats: what cannot end it, and the gaps that it reports."""
from types import SimpleNamespace

import pytest
from boards import until

from serial_communication.links import heart as heart_module
from serial_communication.links.heart import Heart


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
