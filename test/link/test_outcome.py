"""The verdict of a status, and the text that contains it where there is no field for it."""
import pytest

from serial_communication.link.outcome import (NOT_SENT, TIMEOUT, Outcome, Verdict, read_text,
                                               verdict_of_failure)
from serial_communication.boards.bus import wire as bus

NO_REPLY = Outcome(TIMEOUT, 'no reply within 0.5 s: look')


@pytest.mark.parametrize('outcome, text', [
    (NO_REPLY, 'status 254 (not known): no reply within 0.5 s: look'),
    (Outcome(NOT_SENT, 'the port is closed'), 'status 253 (not sent): the port is closed'),
    (Outcome(bus.ERROR, 'refused', 0x8002), 'status 3 (ERROR): refused'),
    (Outcome(bus.INVALID, 'refused', 0x40), 'status 255 (INVALID): refused'),
    (Outcome(bus.OK, '4 bytes', as_expected=False),
     'status 2 (answered, but not as expected): 4 bytes')], ids=lambda each: str(each)[:12])
def test_the_text_of_an_outcome_has_its_status_and_message(outcome, text):
    assert outcome.text == text
    assert read_text(text) == (outcome.status, outcome.message)


@pytest.mark.parametrize('before', [
    'service cannot process request: ', 'service [/a] responded with an error: ',
    'service [/a/status 3] responded with an error: service cannot process request: '])
def test_the_status_is_found_behind_words_that_others_put_before_it(before):
    assert read_text(before + NO_REPLY.text) == (TIMEOUT, NO_REPLY.message)


@pytest.mark.parametrize('message', ['', 'two\nlines', 'of: status 3 (ERROR): another', 'für 20 °'])
def test_any_message_can_be_read_back(message):
    assert read_text(NO_REPLY._replace(message=message).text) == (TIMEOUT, message)


@pytest.mark.parametrize('text', [
    '', 'no reply', 'status', 'status 254', 'status 254: no reply', 'exit status 3 (ERROR): no',
    'status x (ERROR): no', 'status 3 ERROR: no', "error processing request: 'NoneType'"])
def test_a_text_of_another_form_has_no_status(text):
    assert read_text(text) == (None, text)


@pytest.mark.parametrize('status, verdict', [
    (NOT_SENT, Verdict.REFUSED), (bus.ERROR, Verdict.REFUSED), (bus.INVALID, Verdict.REFUSED),
    (TIMEOUT, Verdict.NOT_KNOWN), (bus.OK, Verdict.NOT_KNOWN), (bus.SYNC, Verdict.NOT_KNOWN),
    (77, Verdict.NOT_KNOWN), (None, Verdict.NOT_KNOWN)])
def test_only_a_call_that_was_certainly_not_executed_counts_as_refused(status, verdict):
    assert verdict_of_failure(status) is verdict
