"""The Master's session as a state machine: every rule, with a clock of the test's own."""
import logging

import pytest

from serial_communication.boards.bus import master as master_module
from serial_communication.boards.bus.master import (ECHO_TRIES, NOT_SENT, PATIENCE, QUIET, TIMEOUT,
                                                    Call, Condition, Master, State)
from serial_communication.link.sparing_log import SparingLog
from serial_communication.boards.bus import wire as bus
from serial_communication.framing.stream import CHECKSUM, FRAMING, Frame, invalid_frame
from serial_communication.framing.layout import Layout, Value

REPLY_TIMEOUT, MOTION_TIMEOUT = 0.5, 5.0
SYNC_REPLY = bus.Reply(bus.SYNC)
OK_REPLY = bus.Reply(bus.OK)
AIR_REPLY = bus.Reply(bus.OK, bus.Environment(350, 25.63, 48.12).pack())
LIFT, GIMBAL = bus.lift(0, 100), bus.gimbal(1, 30)
AIR = bus.ENVIRONMENT_REQUEST
RAW = bus.Request(bus.FUNCTION, 0x30, b'raw')
OWN = bus.Request(bus.FUNCTION, 0x40)      # a custom function for which no data is expected
READ, OTHER = (bus.Request(bus.FUNCTION, cmd2) for cmd2 in (0x41, 0x42))    # … of two bytes each
TWO_BYTES = Layout('<H', [Value('number')])
LAYOUTS = {LIFT: bus.NO_DATA, GIMBAL: bus.NO_DATA, OWN: bus.NO_DATA,
           AIR: bus.Environment.LAYOUT, READ: TWO_BYTES, OTHER: TWO_BYTES}
ALL_REPEATABLE = (AIR, READ, OTHER)
MOVING_OR_RAW = pytest.mark.parametrize('request_', [LIFT, GIMBAL, RAW], ids=str)
REPEATABLE = pytest.mark.parametrize('request_, answer', [
    (AIR, AIR_REPLY), (bus.echo(b'mine'), bus.Reply(bus.ECHO, b'mine')),
    (bus.SYNC_REQUEST, SYNC_REPLY)], ids=('environment', 'echo', 'sync'))


def invalid(code):
    return bus.Reply(bus.INVALID, bytes((code,)))


def error(code):
    return bus.Reply(bus.ERROR, code.to_bytes(2, 'little'))


class Session:
    """A Master, its clock, and what it says."""

    def __init__(self, caplog, motion_timeout=MOTION_TIMEOUT):
        caplog.set_level(logging.INFO)
        self._caplog = caplog
        self.now = 100.0
        self.nonces = []
        self._motion_timeout = motion_timeout
        self.master = Master(REPLY_TIMEOUT, motion_timeout, SparingLog(
            'bus', logging.getLogger('session'), clock=lambda: self.now), self._nonce)

    def _nonce(self):
        self.nonces.append(b'n%03d' % len(self.nonces))
        return self.nonces[-1]

    def call(self, request, tries=3, poll=False):
        """Submit a call as `BusLink` makes it."""
        slow = request.cmd2 in (bus.LIFT, bus.GIMBAL)
        repeatable = request.cmd1 in (bus.SYNC, bus.ECHO) or request in ALL_REPEATABLE
        call = Call(request, self._motion_timeout if slow else REPLY_TIMEOUT, repeatable, tries,
                    self.now, poll, LAYOUTS.get(request))
        self.master.submit(call)
        return call

    def ask_next(self):
        """What goes out now; None for nothing."""
        return self.master.step(self.now)[0]

    def wake_at(self):
        """When the Master is to be called again at the latest; nothing goes out."""
        return self.master.step(self.now, may_send=False)[1]

    def ask(self):
        """The same; where it is the fence before a request, that comes back: what is behind it."""
        in_step = self.master.state is State.IN_STEP
        request = self.ask_next()
        if in_step and request is not None and request.data in self.nonces:
            self.reply(bus.Reply(bus.ECHO, request.data))
            request = self.ask_next()
        return request

    def reply(self, *replies):
        """Replies that one read brings."""
        for reply in replies:
            wire = bus.encode_reply(reply)
            self.master.received(Frame(wire, reply.cmd1, 0, reply.data, reply), self.now)

    def damage(self, cause=CHECKSUM):
        self.master.damaged(invalid_frame(b'\xa5\0\2\0', cause, 'damaged'), self.now)

    def later(self, seconds):
        self.now += seconds
        self.master.step(self.now, may_send=False)

    def connect(self):
        """A board that answers SYNC, and the ECHO behind it, at once."""
        self.master.connected(self.now)
        assert self.ask() == bus.SYNC_REQUEST
        self.reply(SYNC_REPLY)
        self.find_step()
        return self

    def find_step(self):
        """The ECHO goes out, and comes back."""
        request = self.ask_next()
        assert request == bus.echo(self.nonces[-1])
        self.reply(bus.Reply(bus.ECHO, request.data))
        assert self.master.in_step

    def connect_without_echo(self):
        """A board that answers SYNC, and never an ECHO; found out as the link comes up."""
        self.master.connected(self.now)
        self.ask_next()
        self.reply(SYNC_REPLY)
        for _ in range(ECHO_TRIES):
            assert self.ask_next().cmd1 == bus.ECHO
            self.later(REPLY_TIMEOUT)
        self.sync_and_silence()
        return self

    def sync_and_silence(self):
        """In the place of an ECHO."""
        assert self.ask_next() == bus.SYNC_REQUEST
        self.reply(SYNC_REPLY)
        assert not self.master.in_step and self.ask_next() is None
        self.later(REPLY_TIMEOUT - 0.01)
        assert self.ask_next() is None, 'it is to be silent so long'
        self.later(0.02)
        assert self.master.in_step

    def warnings(self, containing=''):
        return [record.getMessage() for record in self._caplog.records
                if record.levelno >= logging.WARNING and containing in record.getMessage()]


@pytest.fixture
def fresh(caplog):
    """Never connected."""
    return Session(caplog)


@pytest.fixture
def session(fresh):
    """Connected, synchronised and in step."""
    return fresh.connect()


@pytest.fixture
def without_echo(fresh):
    """Connected and synchronised with a board that never echoes."""
    return fresh.connect_without_echo()


# -- 1. one request outstanding; calls before polls -----------------------------------------------

def test_nothing_is_sent_while_a_request_is_outstanding(session):
    calls = [session.call(LIFT), session.call(GIMBAL)]
    assert session.ask() == LIFT
    assert session.ask() is None and session.master.asked == LIFT
    session.later(1.0)
    assert session.ask() is None
    session.reply(OK_REPLY)
    assert calls[0].outcome.success and calls[1].outcome is None
    assert session.ask() == GIMBAL
    session.reply(OK_REPLY)
    assert calls[1].outcome.success and session.ask() is None
    assert session.wake_at() is None


def test_calls_go_in_their_order_and_before_polls(session):
    session.call(RAW)
    assert session.ask() == RAW
    session.call(AIR, poll=True)
    for request in (LIFT, GIMBAL, bus.echo(b'x')):
        session.call(request)
    session.reply(OK_REPLY)
    for request, answer in ((LIFT, OK_REPLY), (GIMBAL, OK_REPLY),
                            (bus.echo(b'x'), bus.Reply(bus.ECHO, b'x')), (AIR, AIR_REPLY)):
        assert session.ask() == request
        session.reply(answer)
    assert session.ask() is None


def test_an_outcome_tells_what_the_board_said(session):
    session.call(AIR)
    call = session.call(AIR)
    session.ask()
    session.reply(AIR_REPLY)
    session.ask()
    session.now += 0.125
    session.reply(AIR_REPLY)
    outcome = call.outcome
    assert (outcome.status, outcome.data, outcome.error_code) == (bus.OK, AIR_REPLY.data, 0)
    assert outcome.success and outcome.round_trip == pytest.approx(0.125)
    assert list(session.master.round_trips) == pytest.approx([0.0, 0.125])


# -- 2. SYNC first --------------------------------------------------------------------------------

def test_nothing_is_sent_before_a_connection(fresh):
    call = fresh.call(LIFT)
    assert fresh.ask() is None
    fresh.later(PATIENCE)
    assert call.outcome.status == NOT_SENT and 'closed' in call.outcome.message


def test_sync_is_asked_until_it_is_answered_and_nothing_else_before(fresh):
    fresh.master.connected(fresh.now)
    for _ in range(7):
        assert fresh.ask() == bus.SYNC_REQUEST
        assert fresh.ask() is None
        fresh.later(REPLY_TIMEOUT)
    call = fresh.call(LIFT)
    assert fresh.ask() == bus.SYNC_REQUEST
    assert not fresh.master.synchronised
    assert fresh.master.condition() is Condition.NO_SYNC
    fresh.reply(SYNC_REPLY)
    assert fresh.master.synchronised
    while fresh.master.in_step is False:
        fresh.find_step()
    assert fresh.ask() == LIFT
    fresh.reply(OK_REPLY)
    assert call.outcome.success


@pytest.mark.parametrize('reply', [OK_REPLY, invalid(0x40), invalid(0x10), error(0x8000),
                                   bus.Reply(bus.ECHO, b'x'), bus.Reply(0x77)], ids=str)
def test_no_other_reply_answers_a_sync(fresh, reply):
    fresh.master.connected(fresh.now)
    assert fresh.ask() == bus.SYNC_REQUEST
    fresh.reply(reply)
    assert not fresh.master.synchronised and fresh.ask() in (None, bus.SYNC_REQUEST)


def test_a_new_connection_begins_with_sync(session):
    session.master.disconnected(session.now, 'unplugged')
    assert session.ask() is None
    session.master.connected(session.now)
    session.call(LIFT)
    assert session.ask() == bus.SYNC_REQUEST


# -- 3., 4. timeouts; what is sent again, and what never ------------------------------------------

@pytest.mark.parametrize('request_, timeout', [
    (LIFT, MOTION_TIMEOUT), (GIMBAL, MOTION_TIMEOUT), (RAW, REPLY_TIMEOUT)], ids=str)
def test_no_reply_within_its_timeout_means_unknown_and_never_again(session, request_, timeout):
    call = session.call(request_)
    assert session.ask() == request_
    assert session.wake_at() == pytest.approx(session.now + timeout)
    session.later(timeout - 0.001)
    assert call.outcome is None
    session.later(0.002)
    assert call.outcome.status == TIMEOUT and not call.outcome.success
    assert 'not known' in call.outcome.message
    assert session.master.timeouts == 1
    session.find_step()
    assert session.ask() is None, 'a request with an unknown outcome was sent again'


@REPEATABLE
def test_what_may_be_repeated_is_sent_once_and_retried_twice(session, request_, answer):
    call = session.call(request_, tries=3)
    for _ in range(3):
        assert call.outcome is None
        assert session.ask() == request_
        session.later(REPLY_TIMEOUT)
        session.find_step()
    assert call.outcome.status == TIMEOUT
    assert session.ask() is None


@REPEATABLE
def test_a_repeated_request_may_succeed(session, request_, answer):
    call = session.call(request_, tries=2)
    for _ in range(2):
        assert session.ask() == request_
        if call.tries:
            session.later(REPLY_TIMEOUT)
            session.find_step()
    session.reply(answer)
    assert call.outcome.success and call.outcome.data == answer.data


@MOVING_OR_RAW
def test_a_request_whose_checksum_failed_at_the_board_goes_again_as_it_is(session, request_):
    call = session.call(request_, tries=3)
    session.call(RAW)
    for _ in range(2):
        assert session.ask() == request_
        session.reply(invalid(0x40))
        session.find_step()
    assert call.outcome is None
    assert session.ask() == request_, 'it goes before the next call'
    session.reply(OK_REPLY)
    assert call.outcome.success
    assert session.master.in_step


@MOVING_OR_RAW
@pytest.mark.parametrize('code', [0x40, 0x20])
def test_an_ok_behind_an_invalid_leaves_it_unknown(session, request_, code):
    """The INVALID was for noise and this is the reply; or this is a doubled one of an earlier
    request. Told refused or sent again it might be executed twice, told success never."""
    call = session.call(request_)
    session.ask()
    session.reply(invalid(code))
    assert call.outcome is None
    echo = session.ask()
    assert echo.cmd1 == bus.ECHO
    session.reply(OK_REPLY)
    assert (call.outcome.status, call.outcome.error_code) == (TIMEOUT, code)
    assert 'not known' in call.outcome.message
    assert session.ask() is None and not session.master.in_step
    session.reply(bus.Reply(bus.ECHO, echo.data))
    assert session.master.in_step and session.ask() is None


@MOVING_OR_RAW
def test_an_error_to_the_echo_behind_an_invalid_is_not_the_requests(session, request_):
    call = session.call(request_)
    session.ask()
    session.reply(invalid(0x40))
    echo = session.ask()
    session.reply(error(0x8000))
    assert call.outcome is None and session.ask() is None
    session.reply(bus.Reply(bus.ECHO, echo.data))
    assert session.ask() == request_
    session.reply(OK_REPLY)
    assert call.outcome.success


def test_a_board_known_not_to_echo_is_asked_again_after_a_sync_and_a_silence(without_echo):
    session = without_echo
    call = session.call(RAW)
    assert session.ask_next() == RAW
    session.reply(invalid(0x40))
    session.sync_and_silence()
    assert session.ask_next() == RAW
    session.reply(OK_REPLY)
    assert call.outcome.success


def test_a_call_goes_before_a_poll_that_is_asked_again(session):
    session.call(AIR, poll=True)
    assert session.ask() == AIR
    lift = session.call(LIFT)
    session.later(REPLY_TIMEOUT)
    session.find_step()
    assert session.ask() == LIFT
    session.reply(OK_REPLY)
    assert lift.outcome.success
    assert session.ask() == AIR


@MOVING_OR_RAW
@pytest.mark.parametrize('end', ['closed', 'no echo'])
def test_an_invalid_that_no_echo_confirms_is_not_told_as_a_refusal(session, request_, end):
    call = session.call(request_)
    session.ask()
    session.reply(invalid(0x40))
    session.ask()
    if end == 'closed':
        session.master.disconnected(session.now, 'unplugged')
    else:
        for _ in range(100):
            session.later(REPLY_TIMEOUT / 5)
            asked = session.ask()
            assert asked is None or asked.cmd1 in (bus.ECHO, bus.SYNC)
            if call.outcome:
                break
    assert call.outcome.status == TIMEOUT and 'not known' in call.outcome.message


@MOVING_OR_RAW
def test_a_request_to_an_unsynchronised_board_goes_again_after_sync(session, request_):
    call = session.call(request_)
    assert session.ask() == request_
    session.reply(invalid(0x10))
    assert not session.master.synchronised
    assert session.ask() == bus.SYNC_REQUEST
    session.later(REPLY_TIMEOUT / 2)
    session.reply(SYNC_REPLY)
    session.find_step()
    assert session.ask() == request_
    session.reply(OK_REPLY)
    assert call.outcome.success


@MOVING_OR_RAW
@pytest.mark.parametrize('code', [0x40, 0x10])
def test_a_request_that_is_never_accepted_is_refused_after_its_tries(session, request_, code):
    call = session.call(request_, tries=3)
    sent = 0
    for _ in range(10):
        asked = session.ask()
        if asked == request_:
            sent += 1
            session.reply(invalid(code))
        elif asked == bus.SYNC_REQUEST:
            session.reply(SYNC_REPLY)
        elif asked:
            session.reply(bus.Reply(bus.ECHO, asked.data))
    assert sent == 3
    assert (call.outcome.status, call.outcome.error_code) == (bus.INVALID, code)
    assert 'nothing was executed' in call.outcome.message


@MOVING_OR_RAW
@pytest.mark.parametrize('reply', [invalid(0x20), invalid(0x77), error(0x8000), error(0x8001),
                                   error(0x8002)], ids=str)
def test_a_refusal_is_told_with_its_code_and_nothing_goes_again(session, request_, reply):
    call = session.call(request_)
    session.ask()
    session.reply(reply)
    if reply.cmd1 == bus.INVALID:
        session.find_step()     # nothing else came: it was for this request
        assert session.ask() is None
    assert call.outcome.status == reply.cmd1 and not call.outcome.success
    assert call.outcome.error_code == reply.error_code
    assert bus.describe_error(reply.error_code) in call.outcome.message
    assert session.ask() is None and session.master.in_step


def test_a_request_tried_in_vain_is_not_sent_after_a_timeout_either(session):
    """INVALID 0x40, sent again, no reply: now the outcome is unknown."""
    call = session.call(LIFT, tries=3)
    session.ask()
    session.reply(invalid(0x40))
    session.find_step()
    assert session.ask() == LIFT
    session.later(MOTION_TIMEOUT)
    assert call.outcome.status == TIMEOUT
    session.find_step()
    assert session.ask() is None


# -- 5. out of step -------------------------------------------------------------------------------

def test_after_a_timeout_nothing_goes_out_before_the_echo_is_back(session):
    first, second = session.call(LIFT), session.call(GIMBAL)
    session.ask()
    session.later(MOTION_TIMEOUT - 1.0)
    second_submitted_late = session.call(RAW)
    session.later(1.0)
    request = session.ask()
    assert request.cmd1 == bus.ECHO and len(request.data) == 4
    assert first.outcome.status == TIMEOUT
    for late in (OK_REPLY, SYNC_REPLY, error(0x8002), AIR_REPLY, bus.Reply(bus.ECHO, b'none'),
                 bus.Reply(bus.ECHO, request.data + b'x'), bus.Reply(bus.OK, request.data)):
        session.reply(late)
        assert session.ask() is None and not session.master.in_step
    session.reply(bus.Reply(bus.ECHO, request.data))
    assert session.master.in_step
    assert session.ask() in (GIMBAL, RAW)
    assert second_submitted_late.outcome is None or second.outcome is None


def test_every_nonce_is_fresh(session):
    session.call(RAW)
    session.ask()
    session.later(REPLY_TIMEOUT)
    asked = []
    for _ in range(ECHO_TRIES):
        request = session.ask()
        assert request.cmd1 == bus.ECHO
        asked.append(request.data)
        session.later(REPLY_TIMEOUT)
    assert len(set(asked)) == ECHO_TRIES


def test_nonces_are_four_random_bytes_by_default(caplog):
    machine = Master(REPLY_TIMEOUT, MOTION_TIMEOUT, SparingLog('bus', logging.getLogger('x')))
    seen = set()
    for _ in range(20):
        machine.connected(0.0)
        machine.step(0.0)
        machine.received(Frame(b'', 0, 0, b'', SYNC_REPLY), 0.0)
        machine.damaged(invalid_frame(b'x', FRAMING, 'noise'), 0.0)
        seen.add(machine.step(0.0)[0].data)
        machine.disconnected(0.0, '')
    assert len(seen) == 20 and {len(nonce) for nonce in seen} == {4}


def test_an_echo_of_an_earlier_nonce_is_dropped(session):
    session.call(RAW)
    session.ask()
    session.later(REPLY_TIMEOUT)
    first = session.ask()
    session.later(REPLY_TIMEOUT)
    second = session.ask()
    session.reply(bus.Reply(bus.ECHO, first.data))
    assert not session.master.in_step and session.ask() is None
    session.reply(bus.Reply(bus.ECHO, second.data))
    assert session.master.in_step


@pytest.mark.parametrize('code', [0x40, 0x20])
def test_an_echo_that_was_not_accepted_goes_again_with_a_fresh_nonce(session, code):
    session.damage(FRAMING)
    first = session.ask()
    session.reply(invalid(code))
    assert session.ask() is None, 'the INVALID may be a late one: its echo may still come'
    session.later(REPLY_TIMEOUT)
    second = session.ask()
    assert (first.cmd1, second.cmd1) == (bus.ECHO, bus.ECHO) and first != second
    session.reply(bus.Reply(bus.ECHO, second.data))
    assert session.master.in_step


def test_an_echo_to_an_unsynchronised_board_is_followed_by_sync_and_an_echo(session):
    session.damage(FRAMING)
    session.ask()
    session.reply(invalid(0x10))
    assert session.ask() == bus.SYNC_REQUEST
    session.reply(SYNC_REPLY)
    session.find_step()


def test_a_board_that_takes_no_echo_for_want_of_sync_is_not_asked_without_end(session):
    session.damage(FRAMING)
    asked = []
    for _ in range(20):
        request = session.ask()
        if request is None:
            session.later(REPLY_TIMEOUT)
            continue
        asked.append(request.cmd1)
        session.reply(SYNC_REPLY if request == bus.SYNC_REQUEST else invalid(0x10))
    assert session.master.in_step and asked.count(bus.ECHO) == 3


def test_an_invalid_not_synchronised_that_nobody_asked_for_asks_for_sync_first(session):
    session.reply(invalid(0x10))
    assert not session.master.synchronised
    call = session.call(LIFT)
    assert session.ask() == bus.SYNC_REQUEST
    session.reply(SYNC_REPLY)
    session.find_step()
    assert session.ask() == LIFT and call.outcome is None


@pytest.mark.parametrize('reply', [OK_REPLY, SYNC_REPLY, error(0x8000), invalid(0x40),
                                   bus.Reply(bus.ECHO, b'x')], ids=str)
def test_a_reply_that_nobody_asked_for_asks_for_an_echo(session, reply):
    session.reply(reply)
    assert not session.master.in_step and len(session.warnings('out of step')) == 1
    session.call(LIFT)
    session.find_step()
    assert session.ask() == LIFT


def test_a_doubled_reply_is_not_the_next_requests(session):
    first, second = session.call(LIFT), session.call(GIMBAL)
    session.ask()
    session.reply(OK_REPLY, OK_REPLY)
    assert first.outcome.success and second.outcome is None
    session.find_step()
    assert session.ask() == GIMBAL


@MOVING_OR_RAW
def test_a_damaged_reply_means_unknown_and_asks_for_an_echo(session, request_):
    call, after = session.call(request_), session.call(AIR)
    session.ask()
    session.damage(CHECKSUM)
    assert call.outcome.status == TIMEOUT and 'not known' in call.outcome.message
    session.find_step()
    assert session.ask() == AIR and after.outcome is None


@REPEATABLE
def test_a_damaged_reply_to_what_may_be_repeated_is_asked_for_again(session, request_, answer):
    call = session.call(request_)
    session.ask()
    session.damage(CHECKSUM)
    assert call.outcome is None
    session.find_step()
    assert session.ask() == request_
    session.reply(answer)
    assert call.outcome.success


@MOVING_OR_RAW
def test_noise_while_a_request_lasts_does_not_hide_the_reply_behind_it(session, request_):
    call = session.call(request_)
    session.ask()
    session.damage(FRAMING)
    assert call.outcome is None
    session.reply(OK_REPLY)
    assert call.outcome.success
    session.call(RAW)
    session.find_step()
    assert session.ask() == RAW


@pytest.mark.parametrize('request_, foreign', [
    (LIFT, SYNC_REPLY), (LIFT, bus.Reply(bus.ECHO, b'n000')), (GIMBAL, bus.Reply(bus.OK + 2)),
    (AIR, SYNC_REPLY), (AIR, bus.Reply(bus.ECHO, AIR_REPLY.data)), (RAW, SYNC_REPLY),
    (RAW, bus.Reply(bus.ECHO, b'raw')), (RAW, bus.Reply(0x77)),
    (bus.echo(b'mine'), bus.Reply(bus.ECHO, b'ours')), (bus.echo(b'mine'), OK_REPLY),
    (bus.SYNC_REQUEST, OK_REPLY)], ids=str)
def test_a_reply_that_cannot_be_this_requests_is_not_given_to_its_caller(session, request_,
                                                                         foreign):
    call = session.call(request_)
    session.ask()
    session.reply(foreign)
    assert call.outcome is None and session.master.asked == request_
    assert not session.master.in_step


def test_a_board_that_never_echoes_gets_a_sync_and_a_silence_with_one_warning(fresh):
    session = fresh.connect_without_echo()
    for _ in range(4):
        session.call(RAW)
        session.later(QUIET)
        assert session.ask_next() == RAW
        session.later(REPLY_TIMEOUT)
        late = session.call(LIFT)
        session.sync_and_silence()
        assert session.ask_next() == LIFT
        session.reply(OK_REPLY)
        assert late.outcome.success
    assert len(session.warnings('does not answer ECHO')) == 1


def test_an_echo_call_that_is_answered_shows_that_the_board_echoes_after_all(without_echo):
    session = without_echo
    call = session.call(bus.echo(b'mine'))
    session.ask_next()
    session.reply(bus.Reply(bus.ECHO, b'mine'))
    assert call.outcome.success
    session.call(LIFT)
    session.find_step()
    assert session.ask_next() == LIFT


@pytest.mark.parametrize('reply', [OK_REPLY, None], ids=('a reply', 'noise'))
def test_what_comes_in_the_silence_is_dropped_and_the_silence_begins_again(session, reply):
    session.call(RAW)
    session.ask()
    for _ in range(1 + ECHO_TRIES):
        session.later(REPLY_TIMEOUT)
        session.ask()
    session.reply(SYNC_REPLY)
    call = session.call(LIFT)
    session.later(REPLY_TIMEOUT - 0.1)
    if reply:
        session.reply(reply)
    else:
        session.damage(FRAMING)
    session.later(REPLY_TIMEOUT - 0.1)
    assert session.ask() is None and not session.master.in_step and call.outcome is None
    session.later(0.2)
    assert session.ask() == LIFT


def test_a_board_that_echoed_before_is_asked_for_an_echo_again(session):
    """Three lost ECHOs are bad luck, not a board without ECHO."""
    session.damage(FRAMING)
    session.find_step()
    session.damage(FRAMING)
    for _ in range(ECHO_TRIES):
        assert session.ask().cmd1 == bus.ECHO
        session.later(REPLY_TIMEOUT)
    assert session.ask() == bus.SYNC_REQUEST
    session.reply(SYNC_REPLY)
    session.later(REPLY_TIMEOUT)
    assert session.master.in_step
    session.damage(FRAMING)
    session.find_step()


def test_a_board_that_does_not_answer_the_sync_in_place_of_an_echo_is_unsynchronised(session):
    session.call(RAW)
    session.ask()
    for _ in range(1 + ECHO_TRIES):
        session.later(REPLY_TIMEOUT)
        session.ask()
    session.later(REPLY_TIMEOUT)
    assert not session.master.synchronised
    assert session.ask() == bus.SYNC_REQUEST


def test_a_late_reply_to_an_earlier_sync_is_not_taken_for_a_callers(fresh):
    """Two SYNCs went out, both answers come late: the second is nobody's."""
    fresh.master.connected(fresh.now)
    fresh.ask()
    fresh.later(REPLY_TIMEOUT)
    assert fresh.ask() == bus.SYNC_REQUEST
    fresh.later(0.1)
    fresh.reply(SYNC_REPLY)               # to the first
    call = fresh.call(bus.SYNC_REQUEST)
    asked = fresh.ask()
    fresh.reply(SYNC_REPLY)               # to the second
    assert call.outcome is None, 'the answer to an earlier SYNC was given to a caller'
    assert asked.cmd1 == bus.ECHO, 'after a timeout the link is out of step'


# -- the fence ------------------------------------------------------------------------------------

@MOVING_OR_RAW
@pytest.mark.parametrize('before, answer', [
    (LIFT, OK_REPLY), (RAW, OK_REPLY), (AIR, AIR_REPLY), (bus.SYNC_REQUEST, SYNC_REPLY),
    (bus.echo(b'mine'), bus.Reply(bus.ECHO, b'mine')), (LIFT, error(0x8002))], ids=str)
def test_before_a_move_or_a_raw_request_a_fresh_echo_returns(session, request_, before, answer):
    session.call(before)
    assert session.ask_next() == before, 'the ECHO behind the SYNC was a fence already'
    session.reply(answer)
    known = len(session.nonces)
    session.call(request_)
    echo = session.ask_next()
    assert echo == bus.echo(session.nonces[-1]) and len(session.nonces) == known + 1
    assert session.ask_next() is None
    session.reply(bus.Reply(bus.ECHO, echo.data))
    assert session.ask_next() == request_


@pytest.mark.parametrize('request_, answer', [
    (bus.SYNC_REQUEST, SYNC_REPLY), (bus.echo(b'mine'), bus.Reply(bus.ECHO, b'mine'))], ids=str)
def test_sync_and_echo_need_no_fence(session, request_, answer):
    for before, reply in ((LIFT, OK_REPLY), (request_, answer), (request_, answer)):
        session.call(before)
        assert session.ask_next() == before
        session.reply(reply)


@pytest.mark.parametrize('request_', [AIR, READ, OWN, LIFT, RAW], ids=str)
def test_a_call_has_a_fence_also_behind_the_same_request(session, request_):
    for number in range(3):
        session.call(request_)
        known = len(session.nonces)
        assert session.ask() == request_
        assert len(session.nonces) - known == (number > 0)
        session.reply(bus.Reply(bus.OK, bytes(LAYOUTS.get(request_, bus.NO_DATA).size)))


def test_a_poll_needs_a_fence_unless_it_follows_its_own_kind(session):
    for request, has_fence in ((READ, False), (READ, False), (OTHER, True), (OTHER, False),
                               (READ, True), (AIR, True), (AIR, False)):
        session.call(request, poll=True)
        known = len(session.nonces)
        assert session.ask() == request
        assert len(session.nonces) - known == has_fence
        session.reply(bus.Reply(bus.OK, bytes(LAYOUTS[request].size)))


@pytest.mark.parametrize('between, answer', [
    (READ, None), (bus.SYNC_REQUEST, SYNC_REPLY), (bus.echo(b'a'), bus.Reply(bus.ECHO, b'a'))],
    ids=str)
def test_a_call_between_two_polls_of_a_kind(session, between, answer):
    """The same request as a call leaves them of a kind, any other exchange does not."""
    for request, poll in ((READ, True), (between, False), (READ, True)):
        session.call(request, poll=poll)
        known = len(session.nonces)
        assert session.ask() == request
        session.reply(answer if answer and not poll else bus.Reply(bus.OK, b'\1\2'))
    assert len(session.nonces) - known == (between != READ)


@pytest.mark.parametrize('code', [0x40, 0x20])
def test_a_repeatable_call_is_refused_only_where_no_ok_follows_the_invalid(session, code):
    call = Call(OWN, REPLY_TIMEOUT, True, 1, session.now, reply_layout=bus.NO_DATA)
    session.master.submit(call)
    assert session.ask_next() == OWN
    session.reply(invalid(code))
    assert call.outcome is None
    echo = session.ask_next()
    session.reply(OK_REPLY, bus.Reply(bus.ECHO, echo.data))
    assert (call.outcome.status, call.outcome.error_code) == (TIMEOUT, code)


def test_a_repeatable_call_is_sent_again_though_an_ok_follows_the_invalid(session):
    call = Call(OWN, REPLY_TIMEOUT, True, 2, session.now, reply_layout=bus.NO_DATA)
    session.master.submit(call)
    session.ask_next()
    session.reply(invalid(0x40))
    echo = session.ask_next()
    session.reply(OK_REPLY)
    assert call.outcome is None
    session.reply(bus.Reply(bus.ECHO, echo.data))
    assert session.ask_next() == OWN
    session.reply(OK_REPLY)
    assert call.outcome.success


def test_a_fence_holds_until_something_else_is_exchanged(session):
    session.later(3600.0)
    session.call(LIFT)
    assert session.ask_next() == LIFT


def test_a_poll_that_comes_up_waits_behind_the_fence_and_its_move(session):
    session.call(AIR)
    session.ask_next()
    session.reply(AIR_REPLY)
    session.call(LIFT)
    echo = session.ask_next()
    session.call(AIR, poll=True)
    session.later(0.001)
    session.reply(bus.Reply(bus.ECHO, echo.data))
    assert session.ask_next() == LIFT
    session.reply(OK_REPLY)
    assert session.ask() == AIR


def test_a_call_that_comes_first_before_a_move_takes_its_fence_away(session):
    session.call(AIR)
    session.call(LIFT)
    assert session.ask_next() == AIR
    session.reply(AIR_REPLY)
    assert session.ask_next().cmd1 == bus.ECHO


@MOVING_OR_RAW
def test_a_reply_that_comes_twice_before_the_fence_returns_is_dropped(session, request_):
    session.call(LIFT)
    session.ask_next()
    session.reply(OK_REPLY)
    call = session.call(request_)
    echo = session.ask_next()
    session.reply(OK_REPLY, bus.Reply(bus.ECHO, echo.data))
    assert session.ask_next() == request_
    session.reply(error(0x8002))
    assert call.outcome.status == bus.ERROR
    assert len(session.warnings('out of step')) == 1, 'a person is told of the doubled reply'


@MOVING_OR_RAW
def test_an_echo_that_comes_twice_does_not_answer_the_request_behind_it(session, request_):
    session.call(AIR)
    session.ask_next()
    session.reply(AIR_REPLY)
    call = session.call(request_)
    echo = session.ask_next()
    session.reply(bus.Reply(bus.ECHO, echo.data))
    assert session.ask_next() == request_
    session.reply(bus.Reply(bus.ECHO, echo.data))
    assert call.outcome is None
    session.reply(OK_REPLY)
    assert call.outcome.success
    session.find_step()


def test_a_fence_whose_echo_is_damaged_or_lost_goes_again_with_a_fresh_nonce(session):
    session.call(AIR)
    session.ask_next()
    session.reply(AIR_REPLY)
    call = session.call(LIFT)
    first = session.ask_next()
    session.damage(CHECKSUM)
    assert session.ask_next() is None and call.outcome is None
    session.later(REPLY_TIMEOUT)
    second = session.ask_next()
    assert second.cmd1 == bus.ECHO and second != first
    session.reply(bus.Reply(bus.ECHO, first.data))
    assert session.ask_next() is None
    session.reply(bus.Reply(bus.ECHO, second.data))
    assert session.ask_next() == LIFT


def test_a_fence_to_a_board_that_was_reset_is_followed_by_sync_and_another(session):
    session.call(AIR)
    session.ask_next()
    session.reply(AIR_REPLY)
    call = session.call(LIFT)
    assert session.ask_next().cmd1 == bus.ECHO
    session.reply(invalid(0x10))
    assert session.ask_next() == bus.SYNC_REQUEST
    session.reply(SYNC_REPLY)
    session.find_step()
    assert session.ask_next() == LIFT
    session.reply(OK_REPLY)
    assert call.outcome.success


@MOVING_OR_RAW
def test_a_fence_that_nobody_answers_ends_within_the_calls_timeout_and_a_second(session, request_):
    session.call(AIR)
    session.ask_next()
    session.reply(AIR_REPLY)
    call, submitted = session.call(request_), session.now
    while call.outcome is None:
        asked = session.ask_next()
        assert asked is None or asked.cmd1 in (bus.ECHO, bus.SYNC)
        session.now = session.wake_at()
        session.later(0.0)
    assert call.outcome.status == NOT_SENT and 'nothing was sent' in call.outcome.message
    assert session.now - submitted <= call.timeout + 1.0


def test_no_fence_goes_out_for_a_caller_that_has_gone(session):
    session.call(AIR)
    session.ask_next()
    call = session.call(LIFT)
    session.reply(AIR_REPLY)
    session.later(0.0)
    call.wait(0.0)
    assert session.ask_next() is None and call.outcome.status == NOT_SENT


def test_a_board_that_echoed_and_stopped_is_served_after_a_sync_and_a_silence(session):
    session.call(AIR)
    session.ask_next()
    session.reply(AIR_REPLY)
    call = session.call(LIFT)
    for _ in range(ECHO_TRIES):
        assert session.ask_next().cmd1 == bus.ECHO
        session.later(REPLY_TIMEOUT)
    session.sync_and_silence()
    assert session.ask_next() == LIFT, 'the silence took the place of the fence'
    session.reply(OK_REPLY)
    assert call.outcome.success
    session.call(GIMBAL)
    assert session.ask_next().cmd1 == bus.ECHO, 'three lost ones were bad luck'


@MOVING_OR_RAW
def test_a_board_that_never_echoes_gets_a_silence_before_a_move_since_its_last_byte(
        without_echo, request_):
    session = without_echo
    session.call(AIR)
    assert session.ask_next() == AIR
    session.later(0.1)
    session.reply(AIR_REPLY)
    call = session.call(request_)
    request, wake_at = session.master.step(session.now)
    assert request is None and wake_at == pytest.approx(session.now + QUIET)
    session.later(QUIET - 0.001)
    assert session.ask_next() is None
    session.later(0.002)
    assert session.ask_next() == request_
    session.reply(OK_REPLY)
    assert call.outcome.success


@pytest.mark.parametrize('request_, answer, poll', [
    (bus.echo(b'mine'), bus.Reply(bus.ECHO, b'mine'), False),
    (bus.SYNC_REQUEST, SYNC_REPLY, False), (AIR, AIR_REPLY, True)],
    ids=('echo', 'sync', 'the same poll'))
def test_a_board_that_never_echoes_gets_no_silence_before_what_needs_no_fence(
        without_echo, request_, answer, poll):
    for number in range(3):
        without_echo.call(request_, poll=poll)
        if poll and not number:
            without_echo.later(QUIET)
        assert without_echo.ask_next() == request_
        without_echo.reply(answer)


@pytest.mark.parametrize('request_, poll', [(AIR, False), (READ, False), (READ, True)])
def test_a_board_that_never_echoes_gets_a_silence_before_another_reading(without_echo, request_,
                                                                         poll):
    session = without_echo
    session.later(QUIET)
    session.call(AIR)
    assert session.ask_next() == AIR
    session.reply(AIR_REPLY)
    session.call(request_, poll=poll)
    assert session.ask_next() is None
    session.later(QUIET + 0.001)
    assert session.ask_next() == request_


# -- data in an OK --------------------------------------------------------------------------------

@pytest.mark.parametrize('request_', [LIFT, GIMBAL, OWN], ids=str)
@pytest.mark.parametrize('data', [b'\0', AIR_REPLY.data], ids=('one byte', 'as an environment'))
def test_an_ok_with_data_answers_what_expects_none_behind_a_fence(session, request_, data):
    for _ in range(2):
        call = session.call(request_)
        assert session.ask() == request_
        session.reply(bus.Reply(bus.OK, data))
        assert call.outcome.success and call.outcome.data == data
    assert session.master.in_step


@pytest.mark.parametrize('request_', [LIFT, GIMBAL, OWN], ids=str)
def test_an_ok_with_data_without_echo_does_not_answer_what_expects_none(without_echo, request_):
    session = without_echo
    call = session.call(request_)
    assert session.ask_next() == request_
    session.reply(AIR_REPLY)
    assert call.outcome is None and not session.master.in_step
    session.later(call.timeout)
    assert call.outcome.status == TIMEOUT
    assert f'{AIR_REPLY}' in call.outcome.message, 'it says why'
    assert session.warnings(f'no reply to "{request_}" within {call.timeout:g} s but OK')


# -- replies of a wrong length --------------------------------------------------------------------

@pytest.mark.parametrize('data', [b'', bytes(4), bytes(7)], ids=len)
@pytest.mark.parametrize('poll', [False, True], ids=('call', 'poll'))
def test_a_reply_of_a_wrong_length_is_told_as_that_and_at_once(session, data, poll):
    """A poll without a fence is sent once more behind the ECHO: it may have been another's."""
    if poll:
        session.call(AIR, poll=True)
        session.ask_next()
        session.reply(AIR_REPLY)
    call = session.call(AIR, poll=poll)
    assert session.ask_next() == AIR
    session.reply(bus.Reply(bus.OK, data))
    if poll:
        assert call.outcome is None
        session.find_step()
        assert session.ask_next() == AIR
        session.reply(bus.Reply(bus.OK, data))
    outcome = call.outcome
    assert (outcome.success, outcome.status, outcome.data) == (False, bus.OK, data)
    assert f'{len(data)} bytes' in outcome.message and '6 were expected' in outcome.message
    assert session.master.timeouts == 0 and session.master.length_errors == 1 + poll
    assert len(session.warnings()) == 1
    session.call(AIR)
    session.find_step()


def test_what_may_not_be_repeated_is_told_of_a_wrong_length_at_once_and_goes_never_again(session):
    call = Call(RAW, REPLY_TIMEOUT, False, 3, session.now, reply_layout=Layout('<2x', ()))
    session.master.submit(call)
    assert session.ask_next() == RAW
    session.reply(OK_REPLY)
    assert call.outcome.status == bus.OK and not call.outcome.success
    session.find_step()
    assert session.ask_next() is None


def test_without_echo_the_right_length_may_still_come_to_what_may_not_be_repeated(without_echo):
    session = without_echo
    session.call(AIR)
    session.ask_next()
    session.reply(AIR_REPLY)
    session.later(QUIET)
    call = Call(RAW, REPLY_TIMEOUT, False, 3, session.now, reply_layout=Layout('<2x', ()))
    session.master.submit(call)
    assert session.ask_next() == RAW
    session.reply(OK_REPLY)
    assert call.outcome is None
    session.reply(bus.Reply(bus.OK, b'ab'))
    assert call.outcome.success


def test_a_reply_with_values_that_cannot_be_is_told_as_that_and_counted(session):
    layout = Layout('<B', [Value('level', maximum=100)])
    for data, success in ((b'\x64', True), (b'\x65', False)):
        call = Call(RAW, REPLY_TIMEOUT, False, 3, session.now, reply_layout=layout)
        session.master.submit(call)
        assert session.ask() == RAW
        session.reply(bus.Reply(bus.OK, data))
        assert call.outcome.status == bus.OK and call.outcome.success == success
    assert 'level is 101, above the maximum of 100' in call.outcome.message
    assert session.master.implausible == 1 and session.master.length_errors == 0


@pytest.mark.parametrize('reply, told', [(AIR_REPLY, True), (bus.Reply(bus.OK), False),
                                         (error(0x8000), False)], ids=str)
def test_on_success_is_called_with_a_valid_reading_only(session, reply, told):
    readings = []
    session.master.submit(Call(AIR, REPLY_TIMEOUT, True, 1, session.now, poll=True,
                               reply_layout=bus.Environment.LAYOUT, on_success=readings.append))
    session.ask_next()
    session.reply(reply)
    assert [outcome.data for outcome in readings] == ([AIR_REPLY.data] if told else [])


# -- INVALID in every state -----------------------------------------------------------------------


@pytest.mark.parametrize('code', [0x40, 0x20, 0x10])
def test_invalid_in_the_silence(session, code):
    session.call(RAW)
    session.ask()
    for _ in range(1 + ECHO_TRIES):
        session.later(REPLY_TIMEOUT)
        session.ask()
    session.reply(SYNC_REPLY)
    session.reply(invalid(code))
    assert session.ask() == (bus.SYNC_REQUEST if code == 0x10 else None)
    session.later(REPLY_TIMEOUT)
    assert session.master.in_step or session.ask() == bus.SYNC_REQUEST


@REPEATABLE
@pytest.mark.parametrize('code', [0x40, 0x10])
def test_invalid_to_what_may_be_repeated(session, request_, answer, code):
    call = session.call(request_)
    assert session.ask() == request_
    session.reply(invalid(code))
    if code == 0x10:
        assert session.ask() == bus.SYNC_REQUEST
        session.reply(SYNC_REPLY)
    if not session.master.in_step:
        session.find_step()
    assert session.ask() == request_
    session.reply(answer)
    assert call.outcome.success


def test_a_board_that_answers_every_echo_with_invalid_is_served_in_the_end(session):
    session.damage(FRAMING)
    call = session.call(LIFT)
    asked = []
    for _ in range(10):
        request = session.ask()
        if request == LIFT:
            break
        if request is None:
            session.later(REPLY_TIMEOUT)
            continue
        asked.append(request.cmd1)
        session.reply(SYNC_REPLY if request.cmd1 == bus.SYNC else invalid(0x20))
    assert asked == [bus.ECHO] * ECHO_TRIES + [bus.SYNC]
    session.reply(OK_REPLY)
    assert call.outcome.success


# -- the port closes ------------------------------------------------------------------------------

@MOVING_OR_RAW
def test_a_call_that_was_outstanding_is_unknown_and_those_that_waited_are_not_sent(session,
                                                                                   request_):
    sent, waiting, poll = session.call(request_), session.call(LIFT), session.call(AIR, poll=True)
    session.ask()
    session.master.disconnected(session.now, 'unplugged')
    assert sent.outcome.status == TIMEOUT and 'unplugged' in sent.outcome.message
    assert waiting.outcome.status == poll.outcome.status == NOT_SENT
    assert 'nothing was sent' in waiting.outcome.message


@pytest.mark.parametrize('seen', [True, False], ids=('queued', 'in the inbox'))
def test_nothing_of_before_is_sent_after_a_reconnect(session, seen):
    session.call(LIFT)
    session.ask()
    session.call(GIMBAL)
    if seen:
        session.later(0.0)
    session.master.disconnected(session.now, 'unplugged')
    session.connect()
    if not session.master.in_step:
        session.find_step()
    assert session.ask() is None


def test_after_a_reconnect_an_echo_goes_before_any_call(session):
    """The reply to a call that was cut off may still come, behind that to the SYNC."""
    session.call(LIFT)
    session.ask()
    session.master.disconnected(session.now, 'unplugged')
    session.master.connected(session.now)
    assert session.ask_next() == bus.SYNC_REQUEST
    session.reply(SYNC_REPLY)
    call = session.call(AIR)
    session.find_step()
    assert session.ask_next() == AIR and call.outcome is None


def test_a_call_submitted_in_the_instant_of_the_closing_is_refused_with_the_others(session):
    """It waits in the inbox, where no tick has seen it."""
    call = session.call(LIFT)
    session.master.disconnected(session.now, 'unplugged')
    assert call.outcome is not None and call.outcome.status == NOT_SENT


def test_a_request_that_did_not_leave_the_port_is_not_sent(session):
    call = session.call(LIFT)
    session.ask()
    session.master.not_sent('the port takes no data')
    assert call.outcome.status == NOT_SENT and 'takes no data' in call.outcome.message
    assert session.master.asked is None


def test_a_repeated_request_that_did_not_leave_this_time_was_sent_before(session):
    """What a caller is told is true: "nothing was sent" would not be."""
    call = session.call(AIR)
    session.ask()
    session.later(REPLY_TIMEOUT)
    session.find_step()
    assert session.ask() == AIR
    session.master.not_sent('the port takes no data')
    assert call.outcome.status == TIMEOUT


def test_a_repeated_request_that_waits_as_the_port_closes_was_sent_before(session):
    call = session.call(AIR)
    session.ask()
    session.later(REPLY_TIMEOUT)
    session.master.disconnected(session.now, 'unplugged')
    assert call.outcome.status == TIMEOUT


# -- waiting --------------------------------------------------------------------------------------

def test_a_call_behind_a_motion_waits_for_it(session):
    session.call(LIFT)
    session.ask()
    call = session.call(RAW)
    session.later(MOTION_TIMEOUT - 0.1)
    assert call.outcome is None
    session.reply(OK_REPLY)
    assert session.ask() == RAW


def test_a_queued_call_expires_unsent(session):
    session.call(LIFT)
    session.ask()
    session.later(1.0)
    session.call(GIMBAL)
    call = session.call(RAW)
    session.reply(OK_REPLY)
    assert session.ask() == GIMBAL
    session.later(MOTION_TIMEOUT)
    assert call.outcome.status == NOT_SENT and 'nothing was sent' in call.outcome.message
    while True:
        asked = session.ask()
        assert asked != RAW
        if asked is None:
            break
        session.reply(bus.Reply(bus.ECHO, asked.data))


def test_a_call_to_a_board_that_never_synchronises_expires_soon(fresh):
    fresh.master.connected(fresh.now)
    fresh.ask()
    call = fresh.call(LIFT)
    fresh.later(0.0)
    assert fresh.wake_at() <= fresh.now + PATIENCE
    fresh.later(REPLY_TIMEOUT)
    fresh.ask()
    fresh.later(PATIENCE)
    assert call.outcome.status == NOT_SENT and 'SYNC' in call.outcome.message


def test_a_call_to_a_board_gone_deaf_is_answered_within_its_timeout_and_a_second(session):
    """While the link looks for its step it serves nobody, so nobody waits for their turn."""
    session.call(RAW)
    session.ask()
    session.later(REPLY_TIMEOUT)
    call, submitted = session.call(bus.Request(bus.FUNCTION, 0x31, b'second')), session.now
    for _ in range(100):
        session.ask()
        session.later(0.05)
        if call.outcome is not None:
            break
    assert call.outcome.status == NOT_SENT
    assert session.now - submitted <= REPLY_TIMEOUT + 1.0 + 0.1


def test_a_doubt_that_comes_late_ends_within_the_timeout_and_a_second(caplog):
    session = Session(caplog, PATIENCE).connect()
    session.call(LIFT)
    session.ask()
    call, submitted = session.call(RAW), session.now
    session.later(PATIENCE - 0.1)
    session.reply(OK_REPLY)
    assert session.ask() == RAW
    session.later(REPLY_TIMEOUT - 0.1)
    session.reply(invalid(0x40))
    while call.outcome is None:
        asked = session.ask()
        assert asked is None or asked.cmd1 == bus.ECHO
        session.now = session.wake_at()
        session.later(0.0)
    assert call.outcome.status == TIMEOUT
    assert session.now - submitted <= REPLY_TIMEOUT + 1.0


@MOVING_OR_RAW
def test_a_caller_that_has_given_up_is_never_sent(session, request_):
    session.call(LIFT)
    session.ask()
    call = session.call(request_)
    outcome = call.wait(0.0)
    assert outcome.status == NOT_SENT
    session.reply(OK_REPLY)
    assert session.ask() is None
    assert call.outcome is outcome


def test_a_caller_that_has_given_up_is_not_sent_again(session):
    call = session.call(LIFT)
    session.ask()
    outcome = call.wait(0.0)
    assert outcome.status == TIMEOUT and 'not known' in outcome.message
    session.reply(invalid(0x40))
    session.find_step()
    assert session.ask() is None
    assert call.outcome is outcome


def test_the_first_outcome_stands():
    call = Call(LIFT, 1.0, False, 1, 0.0)
    first, second = (master_module.Outcome(status, '') for status in (NOT_SENT, bus.OK))
    call.finish(first)
    call.finish(second)
    assert call.wait(0.0) is first
    assert not call.claim()


def test_the_deadline_is_that_of_the_request_or_of_a_waiting_call(session):
    session.call(RAW)
    session.ask()
    session.call(LIFT)
    assert session.wake_at() == pytest.approx(session.now + REPLY_TIMEOUT)


# -- conditions -----------------------------------------------------------------------------------

def test_the_condition_says_what_is_amiss(fresh):
    assert fresh.master.condition() is Condition.SYNCHRONISING
    fresh.connect()
    assert fresh.master.condition() is Condition.READY
    fresh.damage(FRAMING)
    assert fresh.master.condition() is Condition.OUT_OF_STEP
    fresh.ask()
    fresh.later(REPLY_TIMEOUT)
    assert fresh.master.condition() is Condition.NO_ECHO
    fresh.find_step()
    assert fresh.master.condition() is Condition.READY


def test_a_bad_line_is_reported_sparingly(session):
    for _ in range(100):
        session.damage(FRAMING)
        session.find_step()
    assert len(session.warnings('out of step')) == 1


# -- replies that nobody has seen -----------------------------------------------------------------

def test_after_a_stall_nothing_goes_out_before_an_echo_has_returned(session):
    session.master.missed('the bridge stalled', session.now)
    call = session.call(AIR)
    session.find_step()
    assert session.ask_next() == AIR
    session.reply(AIR_REPLY)
    assert call.outcome.success
    assert len(session.warnings('out of step: the bridge stalled')) == 1


@MOVING_OR_RAW
def test_a_call_that_a_stall_came_upon_succeeds_if_its_reply_comes_after_that(session, request_):
    call = session.call(request_)
    assert session.ask() == request_
    session.master.missed('the bridge stalled', session.now)
    session.reply(OK_REPLY)
    assert call.outcome.success
    session.find_step()


@MOVING_OR_RAW
def test_a_call_whose_reply_was_dropped_is_not_known(session, request_):
    call = session.call(request_)
    assert session.ask() == request_
    session.master.missed('the bridge stalled', session.now)
    session.later(MOTION_TIMEOUT)
    assert call.outcome.status == TIMEOUT
    session.find_step()
    assert session.ask_next() is None, 'it is not sent again'


@MOVING_OR_RAW
@pytest.mark.parametrize('code', [bus.CHECKSUM_MISMATCH, bus.NOT_SYNCHRONISED, bus.TOO_LONG])
def test_an_invalid_after_a_stall_may_be_of_noise_behind_the_reply_that_was_dropped(
        session, request_, code):
    call = session.call(request_)
    assert session.ask() == request_
    session.master.missed('the bridge stalled', session.now)
    session.reply(invalid(code))
    assert call.outcome.status == TIMEOUT and call.outcome.error_code == code
    assert session.master.synchronised == (code != bus.NOT_SYNCHRONISED)


@MOVING_OR_RAW
def test_a_stall_before_the_echo_that_would_confirm_an_invalid_leaves_it_unknown(
        session, request_):
    call = session.call(request_)
    assert session.ask() == request_
    session.reply(invalid(bus.CHECKSUM_MISMATCH))
    session.master.missed('the bridge stalled', session.now)
    assert call.outcome.status == TIMEOUT
    session.find_step()
    assert session.ask_next() is None, 'it is not sent again'


def test_a_reading_that_a_stall_came_upon_is_asked_for_again(session):
    call = session.call(AIR)
    assert session.ask() == AIR
    session.master.missed('the bridge stalled', session.now)
    session.later(REPLY_TIMEOUT)
    session.find_step()
    assert session.ask_next() == AIR
    session.reply(AIR_REPLY)
    assert call.outcome.success


def test_a_silence_that_a_stall_broke_begins_anew(fresh):
    fresh.connect_without_echo()
    fresh.master.missed('the bridge stalled', fresh.now)
    assert fresh.ask_next() == bus.SYNC_REQUEST
    fresh.reply(SYNC_REPLY)
    fresh.later(REPLY_TIMEOUT * 0.6)
    fresh.master.missed('the bridge stalled', fresh.now)
    fresh.later(REPLY_TIMEOUT * 0.6)
    assert not fresh.master.in_step and fresh.ask_next() is None
    fresh.later(REPLY_TIMEOUT * 0.5)
    assert fresh.master.in_step
