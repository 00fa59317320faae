"""The verdict of a status."""
import pytest

from serial_communication.link.outcome import NOT_SENT, TIMEOUT, Verdict, verdict_of_failure
from serial_communication.boards.bus import wire as bus


@pytest.mark.parametrize('status, verdict', [
    (NOT_SENT, Verdict.REFUSED), (bus.ERROR, Verdict.REFUSED), (bus.INVALID, Verdict.REFUSED),
    (TIMEOUT, Verdict.NOT_KNOWN), (bus.OK, Verdict.NOT_KNOWN), (bus.SYNC, Verdict.NOT_KNOWN),
    (77, Verdict.NOT_KNOWN)])
def test_only_a_call_that_was_certainly_not_executed_counts_as_refused(status, verdict):
    assert verdict_of_failure(status) is verdict
