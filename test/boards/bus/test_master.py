"""The Master's session as a state machine: every rule; the tests set the time."""
import logging

import pytest

from serial_communication.boards.bus.call import NOT_READY_WAIT, Call
from serial_communication.boards.bus.master import FENCE_AGE, FENCE_SILENCE, Master
from serial_communication.boards.bus.session import ECHO_TRIES, Condition, SessionState
from serial_communication.link.outcome import NOT_SENT, TIMEOUT, Outcome
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
CUSTOM = bus.Request(bus.FUNCTION, 0x40)      # a custom function without data in its OK
READ, OTHER = (bus.Request(bus.FUNCTION, cmd2) for cmd2 in (0x41, 0x42))    # two bytes in the OK
STOP = bus.Request(bus.FUNCTION, 0x2F)
TWO_BYTES = Layout('<H', [Value('number')])
LAYOUTS = {LIFT: bus.NO_DATA, GIMBAL: bus.NO_DATA, CUSTOM: bus.NO_DATA, STOP: bus.NO_DATA,
           AIR: bus.Environment.LAYOUT, READ: TWO_BYTES, OTHER: TWO_BYTES}
ALL_REPEATABLE = (AIR, READ, OTHER, STOP)
MOVING_OR_RAW = pytest.mark.parametrize('request_', [LIFT, GIMBAL, RAW], ids=str)
REPEATABLE = pytest.mark.parametrize('request_, answer', [
    (AIR, AIR_REPLY), (bus.echo(b'mine'), bus.Reply(bus.ECHO, b'mine')),
    (bus.SYNC_REQUEST, SYNC_REPLY)], ids=('environment', 'echo', 'sync'))


def invalid(code):
    return bus.Reply(bus.INVALID, bytes((code,)))


def error(code):
    return bus.Reply(bus.ERROR, code.to_bytes(2, 'little'))


class Session:
    """A Master with its clock and its log."""

    def __init__(self, caplog, motion_timeout=MOTION_TIMEOUT):
        caplog.set_level(logging.INFO)
        self._caplog = caplog
        self.now = 100.0
        self.nonces = []
        self.dropped = []       # when each request was sent for which output was dropped
        self.begun_anew = []    # when the board may have, since the test began
        self.announces = False
        self._motion_timeout = motion_timeout
        self.master = Master(REPLY_TIMEOUT, motion_timeout, SparingLog(
            'bus', logging.getLogger('session'), clock=lambda: self.now), self._nonce,
            drop_output=self.dropped.append, begun_anew=self._begin_anew,
            still_announces=lambda: self.announces)

    def _begin_anew(self, now):
        self.begun_anew.append(now)
        self.announces = False

    def _nonce(self):
        self.nonces.append(b'n%03d' % len(self.nonces))
        return self.nonces[-1]

    def call(self, request, tries=3, poll=False):
        """Submit a call as `BusLink` makes it."""
        slow = request.cmd2 in (bus.LIFT, bus.GIMBAL)
        repeatable = request.cmd1 in (bus.SYNC, bus.ECHO) or request in ALL_REPEATABLE
        return self.submit(request, self._motion_timeout if slow else REPLY_TIMEOUT, tries, poll,
                           repeatable=repeatable, reply=LAYOUTS.get(request, bus.ANY_DATA),
                           interrupts=request == STOP)

    def submit(self, request, timeout=REPLY_TIMEOUT, tries=3, poll=False, on_success=None,
               **function):
        call = Call(request, bus.Function('a function', request.cmd2, request.cmd1, **function),
                    timeout, tries, self.now, poll, on_success)
        self.master.submit(call)
        return call

    def next_request(self):
        """The request to send now, or None."""
        return self.master.step(self.now)[0]

    def wake_at(self):
        """When the Master has to be called again at the latest; nothing is sent."""
        return self.master.step(self.now, port_ready=False)[1]

    def send_next(self):
        """The request to send now, or None. A fence before it is answered first."""
        in_step = self.master.state is SessionState.IN_STEP
        request = self.next_request()
        if in_step and request is not None and request.data in self.nonces:
            self.reply(bus.Reply(bus.ECHO, request.data))
            request = self.next_request()
        return request

    def reply(self, *replies):
        """Receive replies in one read."""
        for reply in replies:
            wire = bus.encode_reply(reply)
            self.master.received(Frame(wire, reply.cmd1, 0, reply.data, reply), self.now)

    def damage(self, cause=CHECKSUM):
        self.master.damaged(invalid_frame(b'\xa5\0\2\0', cause, 'damaged'), self.now)

    def later(self, seconds):
        self.now += seconds
        self.master.step(self.now, port_ready=False)

    def connect(self):
        """Connect to a board that answers SYNC, and the ECHO after it, at once."""
        self.master.connected(self.now)
        assert self.send_next() == bus.SYNC_REQUEST
        self.reply(SYNC_REPLY)
        self.get_in_step()
        return self

    def get_in_step(self):
        """The ECHO is sent, and returns."""
        request = self.next_request()
        assert request == bus.echo(self.nonces[-1])
        self.reply(bus.Reply(bus.ECHO, request.data))
        assert self.master.in_step

    def connect_without_echo(self):
        """Connect to a board that answers SYNC but never an ECHO."""
        self.master.connected(self.now)
        self.next_request()
        self.reply(SYNC_REPLY)
        for _ in range(ECHO_TRIES):
            assert self.next_request().cmd1 == bus.ECHO
            self.later(REPLY_TIMEOUT)
        self.sync_and_silence()
        return self

    def sync_and_silence(self):
        """They replace an ECHO."""
        assert self.next_request() == bus.SYNC_REQUEST
        self.reply(SYNC_REPLY)
        assert not self.master.in_step and self.next_request() is None
        self.later(REPLY_TIMEOUT - 0.01)
        assert self.next_request() is None, 'the silence has to last that long'
        self.later(0.02)
        assert self.master.in_step

    def warnings(self, containing=''):
        return [record.getMessage() for record in self._caplog.records
                if record.levelno >= logging.WARNING and containing in record.getMessage()]


@pytest.fixture
def fresh(caplog):
    """A session that was never connected."""
    return Session(caplog)


@pytest.fixture
def session(fresh):
    """A session that is connected, synchronised and in step."""
    fresh.connect()
    assert fresh.begun_anew == [fresh.now]
    del fresh.begun_anew[:]
    return fresh


@pytest.fixture
def without_echo(fresh):
    """A session that is connected and synchronised with a board that never echoes."""
    return fresh.connect_without_echo()


# -- 1. one request outstanding; calls before polls -----------------------------------------------

def test_nothing_is_sent_while_a_request_is_outstanding(session):
    calls = [session.call(LIFT), session.call(GIMBAL)]
    assert session.send_next() == LIFT
    assert session.send_next() is None and session.master.outstanding_call.request == LIFT
    session.later(1.0)
    assert session.send_next() is None
    session.reply(OK_REPLY)
    assert calls[0].outcome.success and calls[1].outcome is None
    assert session.send_next() == GIMBAL
    session.reply(OK_REPLY)
    assert calls[1].outcome.success and session.send_next() is None
    assert session.wake_at() is None


def test_calls_are_sent_in_order_and_before_polls(session):
    session.call(RAW)
    assert session.send_next() == RAW
    session.call(AIR, poll=True)
    for request in (LIFT, GIMBAL, bus.echo(b'x')):
        session.call(request)
    session.reply(OK_REPLY)
    for request, answer in ((LIFT, OK_REPLY), (GIMBAL, OK_REPLY),
                            (bus.echo(b'x'), bus.Reply(bus.ECHO, b'x')), (AIR, AIR_REPLY)):
        assert session.send_next() == request
        session.reply(answer)
    assert session.send_next() is None


def test_an_outcome_has_the_data_of_the_reply(session):
    session.call(AIR)
    call = session.call(AIR)
    session.send_next()
    session.reply(AIR_REPLY)
    session.send_next()
    session.now += 0.125
    session.reply(AIR_REPLY)
    outcome = call.outcome
    assert (outcome.status, outcome.data, outcome.error_code) == (bus.OK, AIR_REPLY.data, 0)
    assert outcome.success and outcome.round_trip == pytest.approx(0.125)
    assert list(session.master.round_trips) == pytest.approx([0.0, 0.125])


# -- 2. SYNC first --------------------------------------------------------------------------------

def test_nothing_is_sent_before_a_connection(fresh):
    call = fresh.call(LIFT)
    assert fresh.send_next() is None
    fresh.later(NOT_READY_WAIT)
    assert call.outcome.status == NOT_SENT and 'closed' in call.outcome.message


def test_only_sync_is_sent_until_it_is_answered(fresh):
    fresh.master.connected(fresh.now)
    for _ in range(7):
        assert fresh.send_next() == bus.SYNC_REQUEST
        assert fresh.send_next() is None
        fresh.later(REPLY_TIMEOUT)
    call = fresh.call(LIFT)
    assert fresh.send_next() == bus.SYNC_REQUEST
    assert not fresh.master.synchronised
    assert fresh.master.condition() is Condition.NO_SYNC
    fresh.reply(SYNC_REPLY)
    assert fresh.master.synchronised
    while fresh.master.in_step is False:
        fresh.get_in_step()
    assert fresh.send_next() == LIFT
    fresh.reply(OK_REPLY)
    assert call.outcome.success


@pytest.mark.parametrize('reply', [OK_REPLY, invalid(0x40), invalid(0x10), error(0x8000),
                                   bus.Reply(bus.ECHO, b'x'), bus.Reply(0x77)], ids=str)
def test_no_other_reply_is_taken_for_the_reply_to_sync(fresh, reply):
    fresh.master.connected(fresh.now)
    assert fresh.send_next() == bus.SYNC_REQUEST
    fresh.reply(reply)
    assert not fresh.master.synchronised and fresh.send_next() in (None, bus.SYNC_REQUEST)


def test_a_reconnect_begins_with_sync(session):
    session.master.disconnected(session.now, 'unplugged')
    assert session.send_next() is None
    session.master.connected(session.now)
    session.call(LIFT)
    assert session.send_next() == bus.SYNC_REQUEST


# -- 3., 4. timeouts; which requests are sent again ------------------------------------------

@pytest.mark.parametrize('request_, timeout', [
    (LIFT, MOTION_TIMEOUT), (GIMBAL, MOTION_TIMEOUT), (RAW, REPLY_TIMEOUT)], ids=str)
def test_without_a_reply_a_move_is_unknown_and_not_repeated(session, request_, timeout):
    call = session.call(request_)
    assert session.send_next() == request_
    assert session.wake_at() == pytest.approx(session.now + timeout)
    session.later(timeout - 0.001)
    assert call.outcome is None
    session.later(0.002)
    assert call.outcome.status == TIMEOUT and not call.outcome.success
    assert 'not known' in call.outcome.message
    assert session.master.timeouts == 1
    session.get_in_step()
    assert session.send_next() is None, 'a request with an unknown outcome was sent again'


@REPEATABLE
def test_a_repeatable_request_is_tried_three_times(session, request_, answer):
    call = session.call(request_, tries=3)
    for _ in range(3):
        assert call.outcome is None
        assert session.send_next() == request_
        session.later(REPLY_TIMEOUT)
        session.get_in_step()
    assert call.outcome.status == TIMEOUT
    assert session.send_next() is None


@REPEATABLE
def test_a_repeated_request_can_succeed(session, request_, answer):
    call = session.call(request_, tries=2)
    for _ in range(2):
        assert session.send_next() == request_
        if call.tries:
            session.later(REPLY_TIMEOUT)
            session.get_in_step()
    session.reply(answer)
    assert call.outcome.success and call.outcome.data == answer.data


@MOVING_OR_RAW
def test_a_request_is_sent_again_after_invalid_checksum(session, request_):
    call = session.call(request_, tries=3)
    session.call(RAW)
    for _ in range(2):
        assert session.send_next() == request_
        session.reply(invalid(0x40))
        session.get_in_step()
    assert call.outcome is None
    assert session.send_next() == request_, 'it goes before the next call'
    session.reply(OK_REPLY)
    assert call.outcome.success
    assert session.master.in_step


@MOVING_OR_RAW
@pytest.mark.parametrize('answer', [lambda session: session.reply(OK_REPLY), Session.damage],
                         ids=('ok', 'damaged'))
@pytest.mark.parametrize('code', [0x40, 0x20, 0x10])
def test_an_ok_after_an_invalid_makes_the_outcome_unknown(session, request_, answer, code):
    """Either the INVALID was for noise and the OK is the reply, or the OK is a doubled reply to an
    earlier request. Neither "refused" nor "success" is safe then, nor is another try."""
    call = session.call(request_)
    session.send_next()
    session.reply(invalid(code))
    assert call.outcome is None
    if code == 0x10:
        assert session.send_next() == bus.SYNC_REQUEST
    else:
        echo = session.send_next()
        assert echo.cmd1 == bus.ECHO
    answer(session)
    assert (call.outcome.status, call.outcome.error_code) == (TIMEOUT, code)
    assert 'not known' in call.outcome.message
    assert session.send_next() is None and not session.master.in_step
    if code == 0x10:
        session.reply(SYNC_REPLY)
        echo = session.send_next()
    session.reply(bus.Reply(bus.ECHO, echo.data))
    assert session.master.in_step and session.send_next() is None


@MOVING_OR_RAW
def test_an_ok_after_invalid_not_synchronised_and_sync_makes_the_outcome_unknown(session, request_):
    """The OK arrives between the replies to SYNC and to the ECHO after it."""
    call = session.call(request_, tries=1)
    session.send_next()
    session.reply(invalid(0x10))
    assert session.send_next() == bus.SYNC_REQUEST
    session.reply(SYNC_REPLY)
    assert call.outcome is None, 'a refusal is reported before an ECHO has confirmed it'
    assert session.send_next().cmd1 == bus.ECHO
    session.reply(OK_REPLY)
    assert (call.outcome.status, call.outcome.error_code) == (TIMEOUT, 0x10)


@MOVING_OR_RAW
def test_an_error_to_the_echo_after_an_invalid_is_not_the_reply_to_the_request(session, request_):
    call = session.call(request_)
    session.send_next()
    session.reply(invalid(0x40))
    echo = session.send_next()
    session.reply(error(0x8000))
    assert call.outcome is None and session.send_next() is None
    session.reply(bus.Reply(bus.ECHO, echo.data))
    assert session.send_next() == request_
    session.reply(OK_REPLY)
    assert call.outcome.success


def test_without_echo_a_request_is_sent_again_after_a_sync_and_a_silence(without_echo):
    session = without_echo
    call = session.call(RAW)
    assert session.next_request() == RAW
    session.reply(invalid(0x40))
    session.sync_and_silence()
    assert session.next_request() == RAW
    session.reply(OK_REPLY)
    assert call.outcome.success


def test_a_call_is_sent_before_a_repeated_poll(session):
    session.call(AIR, poll=True)
    assert session.send_next() == AIR
    lift = session.call(LIFT)
    session.later(REPLY_TIMEOUT)
    session.get_in_step()
    assert session.send_next() == LIFT
    session.reply(OK_REPLY)
    assert lift.outcome.success
    assert session.send_next() == AIR


@MOVING_OR_RAW
@pytest.mark.parametrize('end', ['closed', 'no echo'])
@pytest.mark.parametrize('code', [0x40, 0x10])
def test_an_invalid_without_a_confirming_echo_is_not_reported_as_a_refusal(
        session, request_, end, code):
    call = session.call(request_)
    session.send_next()
    session.reply(invalid(code))
    session.send_next()
    if end == 'closed':
        session.master.disconnected(session.now, 'unplugged')
    else:
        for _ in range(100):
            session.later(REPLY_TIMEOUT / 5)
            asked = session.send_next()
            assert asked is None or asked.cmd1 in (bus.ECHO, bus.SYNC)
            if call.outcome:
                break
    assert call.outcome.status == TIMEOUT and 'not known' in call.outcome.message


@MOVING_OR_RAW
def test_a_request_to_an_unsynchronised_board_is_sent_again_after_sync(session, request_):
    call = session.call(request_)
    assert session.send_next() == request_
    session.reply(invalid(0x10))
    assert not session.master.synchronised
    assert session.send_next() == bus.SYNC_REQUEST
    session.later(REPLY_TIMEOUT / 2)
    session.reply(SYNC_REPLY)
    session.get_in_step()
    assert session.send_next() == request_
    session.reply(OK_REPLY)
    assert call.outcome.success


@MOVING_OR_RAW
@pytest.mark.parametrize('code', [0x40, 0x10])
def test_a_request_that_always_gets_invalid_is_refused_after_its_tries(session, request_, code):
    call = session.call(request_, tries=3)
    sent = 0
    for _ in range(10):
        asked = session.send_next()
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
def test_a_refusal_is_reported_with_its_code_and_not_repeated(session, request_, reply):
    call = session.call(request_)
    session.send_next()
    session.reply(reply)
    if reply.cmd1 == bus.INVALID:
        session.get_in_step()     # no other reply: the INVALID was for this request
        assert session.send_next() is None
    assert call.outcome.status == reply.cmd1 and not call.outcome.success
    assert call.outcome.error_code == reply.error_code
    assert bus.describe_error(reply.error_code) in call.outcome.message
    assert session.send_next() is None and session.master.in_step


def test_a_move_sent_again_is_not_repeated_after_a_timeout(session):
    """INVALID 0x40, another try, no reply: now the outcome is unknown."""
    call = session.call(LIFT, tries=3)
    session.send_next()
    session.reply(invalid(0x40))
    session.get_in_step()
    assert session.send_next() == LIFT
    session.later(MOTION_TIMEOUT)
    assert call.outcome.status == TIMEOUT
    session.get_in_step()
    assert session.send_next() is None


# -- 5. out of step -------------------------------------------------------------------------------

def test_after_a_timeout_nothing_is_sent_before_the_echo_returns(session):
    first, second = session.call(LIFT), session.call(GIMBAL)
    session.send_next()
    session.later(MOTION_TIMEOUT - 1.0)
    second_submitted_late = session.call(RAW)
    session.later(1.0)
    request = session.send_next()
    assert request.cmd1 == bus.ECHO and len(request.data) == 4
    assert first.outcome.status == TIMEOUT
    for late in (OK_REPLY, SYNC_REPLY, error(0x8002), AIR_REPLY, bus.Reply(bus.ECHO, b'none'),
                 bus.Reply(bus.ECHO, request.data + b'x'), bus.Reply(bus.OK, request.data)):
        session.reply(late)
        assert session.send_next() is None and not session.master.in_step
    session.reply(bus.Reply(bus.ECHO, request.data))
    assert session.master.in_step
    assert session.send_next() in (GIMBAL, RAW)
    assert second_submitted_late.outcome is None or second.outcome is None


def test_every_nonce_is_new(session):
    session.call(RAW)
    session.send_next()
    session.later(REPLY_TIMEOUT)
    asked = []
    for _ in range(ECHO_TRIES):
        request = session.send_next()
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
    session.send_next()
    session.later(REPLY_TIMEOUT)
    first = session.send_next()
    session.later(REPLY_TIMEOUT)
    second = session.send_next()
    session.reply(bus.Reply(bus.ECHO, first.data))
    assert not session.master.in_step and session.send_next() is None
    session.reply(bus.Reply(bus.ECHO, second.data))
    assert session.master.in_step


@pytest.mark.parametrize('code', [0x40, 0x20])
def test_an_echo_that_gets_invalid_is_sent_again_with_a_new_nonce(session, code):
    session.damage(FRAMING)
    first = session.send_next()
    session.reply(invalid(code))
    assert session.send_next() is None, 'the INVALID may be a late one: its echo may still come'
    session.later(REPLY_TIMEOUT)
    second = session.send_next()
    assert (first.cmd1, second.cmd1) == (bus.ECHO, bus.ECHO) and first != second
    session.reply(bus.Reply(bus.ECHO, second.data))
    assert session.master.in_step


def test_an_echo_to_an_unsynchronised_board_is_followed_by_sync_and_an_echo(session):
    session.damage(FRAMING)
    session.send_next()
    session.reply(invalid(0x10))
    assert session.send_next() == bus.SYNC_REQUEST
    session.reply(SYNC_REPLY)
    session.get_in_step()


def test_the_alternation_of_sync_and_refused_echo_ends(session):
    session.damage(FRAMING)
    asked = []
    for _ in range(20):
        request = session.send_next()
        if request is None:
            session.later(REPLY_TIMEOUT)
            continue
        asked.append(request.cmd1)
        session.reply(SYNC_REPLY if request == bus.SYNC_REQUEST else invalid(0x10))
    assert session.master.in_step and asked.count(bus.ECHO) == 3


def test_an_unrequested_invalid_not_synchronised_leads_to_a_sync(session):
    session.reply(invalid(0x10))
    assert not session.master.synchronised
    call = session.call(LIFT)
    assert session.send_next() == bus.SYNC_REQUEST
    session.reply(SYNC_REPLY)
    session.get_in_step()
    assert session.send_next() == LIFT and call.outcome is None


@pytest.mark.parametrize('reply', [OK_REPLY, SYNC_REPLY, error(0x8000), invalid(0x40),
                                   bus.Reply(bus.ECHO, b'x')], ids=str)
def test_an_unrequested_reply_leads_to_an_echo(session, reply):
    session.reply(reply)
    assert not session.master.in_step and len(session.warnings('out of step')) == 1
    session.call(LIFT)
    session.get_in_step()
    assert session.send_next() == LIFT


def test_a_doubled_reply_is_not_taken_for_the_reply_to_the_next_request(session):
    first, second = session.call(LIFT), session.call(GIMBAL)
    session.send_next()
    session.reply(OK_REPLY, OK_REPLY)
    assert first.outcome.success and second.outcome is None
    session.get_in_step()
    assert session.send_next() == GIMBAL


@MOVING_OR_RAW
def test_after_a_damaged_reply_the_outcome_is_unknown_and_an_echo_is_sent(session, request_):
    call, after = session.call(request_), session.call(AIR)
    session.send_next()
    session.damage(CHECKSUM)
    assert call.outcome.status == TIMEOUT and 'not known' in call.outcome.message
    session.get_in_step()
    assert session.send_next() == AIR and after.outcome is None


@REPEATABLE
def test_a_repeatable_request_is_sent_again_after_a_damaged_reply(session, request_, answer):
    call = session.call(request_)
    session.send_next()
    session.damage(CHECKSUM)
    assert call.outcome is None
    session.get_in_step()
    assert session.send_next() == request_
    session.reply(answer)
    assert call.outcome.success


@MOVING_OR_RAW
def test_a_reply_after_noise_is_taken(session, request_):
    call = session.call(request_)
    session.send_next()
    session.damage(FRAMING)
    assert call.outcome is None
    session.reply(OK_REPLY)
    assert call.outcome.success
    session.call(RAW)
    session.get_in_step()
    assert session.send_next() == RAW


@pytest.mark.parametrize('request_, foreign', [
    (LIFT, SYNC_REPLY), (LIFT, bus.Reply(bus.ECHO, b'n000')), (GIMBAL, bus.Reply(bus.OK + 2)),
    (AIR, SYNC_REPLY), (AIR, bus.Reply(bus.ECHO, AIR_REPLY.data)), (RAW, SYNC_REPLY),
    (RAW, bus.Reply(bus.ECHO, b'raw')), (RAW, bus.Reply(0x77)),
    (bus.echo(b'mine'), bus.Reply(bus.ECHO, b'ours')), (bus.echo(b'mine'), OK_REPLY),
    (bus.SYNC_REQUEST, OK_REPLY)], ids=str)
def test_a_reply_that_does_not_fit_the_request_is_not_returned(session, request_, foreign):
    call = session.call(request_)
    session.send_next()
    session.reply(foreign)
    assert call.outcome is None and session.master.outstanding_call.request == request_
    assert not session.master.in_step


def test_without_echo_a_sync_and_a_silence_replace_it_with_one_warning(fresh):
    session = fresh.connect_without_echo()
    for _ in range(4):
        session.call(RAW)
        session.later(FENCE_SILENCE)
        assert session.next_request() == RAW
        session.later(REPLY_TIMEOUT)
        late = session.call(LIFT)
        session.sync_and_silence()
        assert session.next_request() == LIFT
        session.reply(OK_REPLY)
        assert late.outcome.success
    assert len(session.warnings('does not answer ECHO')) == 1


def test_an_answered_echo_call_shows_that_the_board_knows_echo(without_echo):
    session = without_echo
    call = session.call(bus.echo(b'mine'))
    session.next_request()
    session.reply(bus.Reply(bus.ECHO, b'mine'))
    assert call.outcome.success
    session.call(LIFT)
    session.get_in_step()
    assert session.next_request() == LIFT


@pytest.mark.parametrize('reply', [OK_REPLY, None], ids=('a reply', 'noise'))
def test_a_reply_in_the_silence_is_dropped_and_restarts_it(session, reply):
    session.call(RAW)
    session.send_next()
    for _ in range(1 + ECHO_TRIES):
        session.later(REPLY_TIMEOUT)
        session.send_next()
    session.reply(SYNC_REPLY)
    call = session.call(LIFT)
    session.later(REPLY_TIMEOUT - 0.1)
    if reply:
        session.reply(reply)
    else:
        session.damage(FRAMING)
    session.later(REPLY_TIMEOUT - 0.1)
    assert session.send_next() is None and not session.master.in_step and call.outcome is None
    session.later(0.2)
    assert session.send_next() == LIFT


def test_a_board_that_has_echoed_gets_echo_again_after_the_silence(session):
    """The line lost three ECHOs: the board knows ECHO."""
    session.damage(FRAMING)
    session.get_in_step()
    session.damage(FRAMING)
    for _ in range(ECHO_TRIES):
        assert session.send_next().cmd1 == bus.ECHO
        session.later(REPLY_TIMEOUT)
    assert session.send_next() == bus.SYNC_REQUEST
    session.reply(SYNC_REPLY)
    session.later(REPLY_TIMEOUT)
    assert session.master.in_step
    session.damage(FRAMING)
    session.get_in_step()


def test_a_board_that_does_not_answer_sync_instead_of_echo_is_unsynchronised(session):
    session.call(RAW)
    session.send_next()
    for _ in range(1 + ECHO_TRIES):
        session.later(REPLY_TIMEOUT)
        session.send_next()
    session.later(REPLY_TIMEOUT)
    assert not session.master.synchronised
    assert session.send_next() == bus.SYNC_REQUEST


def test_a_late_reply_to_an_earlier_sync_is_not_returned_to_a_caller(fresh):
    """Two SYNCs were sent, and both replies are late: the second has no request."""
    fresh.master.connected(fresh.now)
    fresh.send_next()
    fresh.later(REPLY_TIMEOUT)
    assert fresh.send_next() == bus.SYNC_REQUEST
    fresh.later(0.1)
    fresh.reply(SYNC_REPLY)               # to the first SYNC
    call = fresh.call(bus.SYNC_REQUEST)
    asked = fresh.send_next()
    fresh.reply(SYNC_REPLY)               # to the second SYNC
    assert call.outcome is None, 'the answer to an earlier SYNC was given to a caller'
    assert asked.cmd1 == bus.ECHO, 'after a timeout the link is out of step'


# -- the fence ------------------------------------------------------------------------------------

@MOVING_OR_RAW
@pytest.mark.parametrize('before, answer', [
    (LIFT, OK_REPLY), (RAW, OK_REPLY), (AIR, AIR_REPLY), (bus.SYNC_REQUEST, SYNC_REPLY),
    (bus.echo(b'mine'), bus.Reply(bus.ECHO, b'mine')), (LIFT, error(0x8002))], ids=str)
def test_before_a_move_or_a_raw_request_a_new_echo_returns(session, request_, before, answer):
    session.call(before)
    assert session.next_request() == before, 'the ECHO behind the SYNC was a fence already'
    session.reply(answer)
    known = len(session.nonces)
    session.call(request_)
    echo = session.next_request()
    assert echo == bus.echo(session.nonces[-1]) and len(session.nonces) == known + 1
    assert session.next_request() is None
    session.reply(bus.Reply(bus.ECHO, echo.data))
    assert session.next_request() == request_


@pytest.mark.parametrize('request_, answer', [
    (bus.SYNC_REQUEST, SYNC_REPLY), (bus.echo(b'mine'), bus.Reply(bus.ECHO, b'mine'))], ids=str)
def test_sync_and_echo_need_no_fence(session, request_, answer):
    for before, reply in ((LIFT, OK_REPLY), (request_, answer), (request_, answer)):
        session.call(before)
        assert session.next_request() == before
        session.reply(reply)


@pytest.mark.parametrize('request_', [AIR, READ, CUSTOM, LIFT, RAW], ids=str)
def test_a_call_has_a_fence_even_after_the_same_request(session, request_):
    for number in range(3):
        session.call(request_)
        known = len(session.nonces)
        assert session.send_next() == request_
        assert len(session.nonces) - known == (number > 0)
        session.reply(bus.Reply(bus.OK, bytes(LAYOUTS.get(request_, bus.NO_DATA).size)))


def test_a_poll_has_a_fence_unless_it_follows_the_same_poll(session):
    for request, has_fence in ((READ, False), (READ, False), (OTHER, True), (OTHER, False),
                               (READ, True), (AIR, True), (AIR, False)):
        session.call(request, poll=True)
        known = len(session.nonces)
        assert session.send_next() == request
        assert len(session.nonces) - known == has_fence
        session.reply(bus.Reply(bus.OK, bytes(LAYOUTS[request].size)))


@pytest.mark.parametrize('between, answer', [
    (READ, None), (bus.SYNC_REQUEST, SYNC_REPLY), (bus.echo(b'a'), bus.Reply(bus.ECHO, b'a'))],
    ids=str)
def test_a_poll_after_a_call_between_two_polls(session, between, answer):
    """A call of the same request leaves the polls unfenced; any other exchange does not."""
    for request, poll in ((READ, True), (between, False), (READ, True)):
        session.call(request, poll=poll)
        known = len(session.nonces)
        assert session.send_next() == request
        session.reply(answer if answer and not poll else bus.Reply(bus.OK, b'\1\2'))
    assert len(session.nonces) - known == (between != READ)


@pytest.mark.parametrize('code', [0x40, 0x20])
def test_a_repeatable_call_is_refused_only_if_no_ok_follows_the_invalid(session, code):
    call = session.submit(CUSTOM, tries=1, repeatable=True)
    assert session.next_request() == CUSTOM
    session.reply(invalid(code))
    assert call.outcome is None
    echo = session.next_request()
    session.reply(OK_REPLY, bus.Reply(bus.ECHO, echo.data))
    assert (call.outcome.status, call.outcome.error_code) == (TIMEOUT, code)


def test_a_repeatable_call_is_sent_again_though_an_ok_follows_the_invalid(session):
    call = session.submit(CUSTOM, tries=2, repeatable=True)
    session.next_request()
    session.reply(invalid(0x40))
    echo = session.next_request()
    session.reply(OK_REPLY)
    assert call.outcome is None
    session.reply(bus.Reply(bus.ECHO, echo.data))
    assert session.next_request() == CUSTOM
    session.reply(OK_REPLY)
    assert call.outcome.success


@pytest.mark.parametrize('request_', [AIR, READ], ids=str)
def test_a_fence_lasts_until_the_next_exchange(session, request_):
    session.later(3600.0)
    session.call(request_)
    assert session.next_request() == request_


@pytest.mark.parametrize('request_', [LIFT, GIMBAL, RAW, CUSTOM], ids=str)
def test_before_a_move_a_fence_is_renewed_after_1_s(session, request_):
    """The other side may stand meanwhile, and would deliver the move when it goes on."""
    session.later(FENCE_AGE - 0.01)
    session.call(request_)
    assert session.next_request() == request_
    session.reply(OK_REPLY)
    session.call(bus.echo(b'x'))
    session.next_request()
    session.reply(bus.Reply(bus.ECHO, b'x'))
    call = session.call(request_)
    session.get_in_step()
    session.later(FENCE_AGE + 0.01)
    assert session.next_request().cmd1 == bus.ECHO
    session.later(NOT_READY_WAIT)
    session.later(MOTION_TIMEOUT)
    assert call.outcome.status == NOT_SENT


def test_a_new_poll_waits_for_the_move_after_the_fence(session):
    session.call(AIR)
    session.next_request()
    session.reply(AIR_REPLY)
    session.call(LIFT)
    echo = session.next_request()
    session.call(AIR, poll=True)
    session.later(0.001)
    session.reply(bus.Reply(bus.ECHO, echo.data))
    assert session.next_request() == LIFT
    session.reply(OK_REPLY)
    assert session.send_next() == AIR


def test_a_call_sent_between_fence_and_move_needs_another_fence(session):
    session.call(AIR)
    session.call(LIFT)
    assert session.next_request() == AIR
    session.reply(AIR_REPLY)
    assert session.next_request().cmd1 == bus.ECHO


@MOVING_OR_RAW
def test_a_doubled_reply_before_the_fence_returns_is_dropped(session, request_):
    session.call(LIFT)
    session.next_request()
    session.reply(OK_REPLY)
    call = session.call(request_)
    echo = session.next_request()
    session.reply(OK_REPLY, bus.Reply(bus.ECHO, echo.data))
    assert session.next_request() == request_
    session.reply(error(0x8002))
    assert call.outcome.status == bus.ERROR
    assert len(session.warnings('out of step')) == 1, 'the doubled reply is logged'


@MOVING_OR_RAW
def test_a_doubled_echo_is_not_taken_for_the_reply_to_the_request(session, request_):
    session.call(AIR)
    session.next_request()
    session.reply(AIR_REPLY)
    call = session.call(request_)
    echo = session.next_request()
    session.reply(bus.Reply(bus.ECHO, echo.data))
    assert session.next_request() == request_
    session.reply(bus.Reply(bus.ECHO, echo.data))
    assert call.outcome is None
    session.reply(OK_REPLY)
    assert call.outcome.success
    session.get_in_step()


def test_a_damaged_or_lost_fence_is_sent_again_with_a_new_nonce(session):
    session.call(AIR)
    session.next_request()
    session.reply(AIR_REPLY)
    call = session.call(LIFT)
    first = session.next_request()
    session.damage(CHECKSUM)
    assert session.next_request() is None and call.outcome is None
    session.later(REPLY_TIMEOUT)
    second = session.next_request()
    assert second.cmd1 == bus.ECHO and second != first
    session.reply(bus.Reply(bus.ECHO, first.data))
    assert session.next_request() is None
    session.reply(bus.Reply(bus.ECHO, second.data))
    assert session.next_request() == LIFT


def test_a_fence_to_a_reset_board_is_followed_by_sync_and_a_new_fence(session):
    session.call(AIR)
    session.next_request()
    session.reply(AIR_REPLY)
    call = session.call(LIFT)
    assert session.next_request().cmd1 == bus.ECHO
    session.reply(invalid(0x10))
    assert session.next_request() == bus.SYNC_REQUEST
    session.reply(SYNC_REPLY)
    session.get_in_step()
    assert session.next_request() == LIFT
    session.reply(OK_REPLY)
    assert call.outcome.success


@MOVING_OR_RAW
def test_a_call_behind_an_unanswered_fence_ends_within_its_timeout_and_a_second(session, request_):
    session.call(AIR)
    session.next_request()
    session.reply(AIR_REPLY)
    call, submitted = session.call(request_), session.now
    while call.outcome is None:
        asked = session.next_request()
        assert asked is None or asked.cmd1 in (bus.ECHO, bus.SYNC)
        session.now = session.wake_at()
        session.later(0.0)
    assert call.outcome.status == NOT_SENT and 'nothing was sent' in call.outcome.message
    assert session.now - submitted <= call.timeout + 1.0


def test_no_fence_is_sent_for_a_caller_that_has_given_up(session):
    session.call(AIR)
    session.next_request()
    call = session.call(LIFT)
    session.reply(AIR_REPLY)
    session.later(0.0)
    call.wait(0.0)
    assert session.next_request() is None and call.outcome.status == NOT_SENT


def test_a_board_that_stops_echoing_is_served_after_a_sync_and_a_silence(session):
    session.call(AIR)
    session.next_request()
    session.reply(AIR_REPLY)
    call = session.call(LIFT)
    for _ in range(ECHO_TRIES):
        assert session.next_request().cmd1 == bus.ECHO
        session.later(REPLY_TIMEOUT)
    session.sync_and_silence()
    assert session.next_request() == LIFT, 'the silence took the place of the fence'
    session.reply(OK_REPLY)
    assert call.outcome.success
    session.call(GIMBAL)
    assert session.next_request().cmd1 == bus.ECHO, 'three lost ones were bad luck'


@MOVING_OR_RAW
def test_without_echo_a_move_waits_for_a_silence_since_the_last_byte(
        without_echo, request_):
    session = without_echo
    session.call(AIR)
    assert session.next_request() == AIR
    session.later(0.1)
    session.reply(AIR_REPLY)
    call = session.call(request_)
    request, wake_at = session.master.step(session.now)
    assert request is None and wake_at == pytest.approx(session.now + FENCE_SILENCE)
    session.later(FENCE_SILENCE - 0.001)
    assert session.next_request() is None
    session.later(0.002)
    assert session.next_request() == request_
    session.reply(OK_REPLY)
    assert call.outcome.success


@pytest.mark.parametrize('request_, answer, poll', [
    (bus.echo(b'mine'), bus.Reply(bus.ECHO, b'mine'), False),
    (bus.SYNC_REQUEST, SYNC_REPLY, False), (AIR, AIR_REPLY, True)],
    ids=('echo', 'sync', 'the same poll'))
def test_without_echo_a_request_that_needs_no_fence_needs_no_silence(
        without_echo, request_, answer, poll):
    for number in range(3):
        without_echo.call(request_, poll=poll)
        if poll and not number:
            without_echo.later(FENCE_SILENCE)
        assert without_echo.next_request() == request_
        without_echo.reply(answer)


@pytest.mark.parametrize('request_, poll', [(AIR, False), (READ, False), (READ, True)])
def test_without_echo_another_reading_waits_for_a_silence(without_echo, request_, poll):
    session = without_echo
    session.later(FENCE_SILENCE)
    session.call(AIR)
    assert session.next_request() == AIR
    session.reply(AIR_REPLY)
    session.call(request_, poll=poll)
    assert session.next_request() is None
    session.later(FENCE_SILENCE + 0.001)
    assert session.next_request() == request_


# -- data in an OK --------------------------------------------------------------------------------

@pytest.mark.parametrize('request_', [LIFT, GIMBAL, CUSTOM], ids=str)
@pytest.mark.parametrize('data', [b'\0', AIR_REPLY.data], ids=('one byte', 'as an environment'))
def test_an_ok_with_unexpected_data_is_taken_behind_a_fence(session, request_, data):
    for _ in range(2):
        call = session.call(request_)
        assert session.send_next() == request_
        session.reply(bus.Reply(bus.OK, data))
        assert call.outcome.success and call.outcome.data == data
    assert session.master.in_step


@pytest.mark.parametrize('request_', [LIFT, GIMBAL, CUSTOM], ids=str)
def test_an_ok_with_unexpected_data_is_not_taken_without_echo(without_echo, request_):
    session = without_echo
    call = session.call(request_)
    assert session.next_request() == request_
    session.reply(AIR_REPLY)
    assert call.outcome is None and not session.master.in_step
    session.later(call.timeout)
    assert call.outcome.status == TIMEOUT
    assert f'{AIR_REPLY}' in call.outcome.message, 'it says why'
    assert session.warnings(f'no reply to "{request_}" within {call.timeout:g} s but OK')


# -- replies of a wrong length --------------------------------------------------------------------

@pytest.mark.parametrize('data', [b'', bytes(4), bytes(7)], ids=len)
@pytest.mark.parametrize('poll', [False, True], ids=('call', 'poll'))
def test_a_reply_of_a_wrong_length_is_reported_at_once(session, data, poll):
    """A poll without a fence is sent once more after the ECHO: the reply may be another's."""
    if poll:
        session.call(AIR, poll=True)
        session.next_request()
        session.reply(AIR_REPLY)
    call = session.call(AIR, poll=poll)
    assert session.next_request() == AIR
    session.reply(bus.Reply(bus.OK, data))
    if poll:
        assert call.outcome is None
        session.get_in_step()
        assert session.next_request() == AIR
        session.reply(bus.Reply(bus.OK, data))
    outcome = call.outcome
    assert (outcome.success, outcome.status, outcome.data) == (False, bus.OK, data)
    assert f'{len(data)} bytes' in outcome.message and '6 were expected' in outcome.message
    assert session.master.timeouts == 0 and session.master.data_errors['length'] == 1 + poll
    assert len(session.warnings()) == 1
    session.call(AIR)
    session.get_in_step()


def test_a_wrong_length_to_an_unrepeatable_request_is_reported_and_not_repeated(session):
    call = session.submit(RAW, reply=Layout('<2x', ()))
    assert session.next_request() == RAW
    session.reply(OK_REPLY)
    assert call.outcome.status == bus.OK and not call.outcome.success
    session.get_in_step()
    assert session.next_request() is None


def test_without_echo_a_reply_of_the_right_length_may_follow_a_wrong_one(without_echo):
    session = without_echo
    session.call(AIR)
    session.next_request()
    session.reply(AIR_REPLY)
    session.later(FENCE_SILENCE)
    call = session.submit(RAW, reply=Layout('<2x', ()))
    assert session.next_request() == RAW
    session.reply(OK_REPLY)
    assert call.outcome is None
    session.reply(bus.Reply(bus.OK, b'ab'))
    assert call.outcome.success


def test_a_reply_with_impossible_values_is_reported_and_counted(session):
    layout = Layout('<B', [Value('level', maximum=100)])
    for data, success in ((b'\x64', True), (b'\x65', False)):
        call = session.submit(RAW, reply=layout)
        assert session.send_next() == RAW
        session.reply(bus.Reply(bus.OK, data))
        assert call.outcome.status == bus.OK and call.outcome.success == success
    assert 'level is 101, above the maximum of 100' in call.outcome.message
    assert session.master.data_errors['implausible'] == 1 and session.master.data_errors['length'] == 0


@pytest.mark.parametrize('reply, is_valid', [(AIR_REPLY, True), (bus.Reply(bus.OK), False),
                                             (error(0x8000), False)], ids=str)
def test_on_success_is_called_with_a_valid_reading_only(session, reply, is_valid):
    readings = []
    session.submit(AIR, tries=1, poll=True, on_success=readings.append, repeatable=True,
                   reply=bus.Environment.LAYOUT)
    session.next_request()
    session.reply(reply)
    assert [outcome.data for outcome in readings] == ([AIR_REPLY.data] if is_valid else [])


# -- INVALID in every state -----------------------------------------------------------------------


@pytest.mark.parametrize('code', [0x40, 0x20, 0x10])
def test_an_invalid_in_the_silence(session, code):
    session.call(RAW)
    session.send_next()
    for _ in range(1 + ECHO_TRIES):
        session.later(REPLY_TIMEOUT)
        session.send_next()
    session.reply(SYNC_REPLY)
    session.reply(invalid(code))
    assert session.send_next() == (bus.SYNC_REQUEST if code == 0x10 else None)
    session.later(REPLY_TIMEOUT)
    assert session.master.in_step or session.send_next() == bus.SYNC_REQUEST


@REPEATABLE
@pytest.mark.parametrize('code', [0x40, 0x10])
def test_an_invalid_to_a_repeatable_request(session, request_, answer, code):
    call = session.call(request_)
    assert session.send_next() == request_
    session.reply(invalid(code))
    if code == 0x10:
        assert session.send_next() == bus.SYNC_REQUEST
        session.reply(SYNC_REPLY)
    if not session.master.in_step:
        session.get_in_step()
    assert session.send_next() == request_
    session.reply(answer)
    assert call.outcome.success


def test_a_board_that_answers_every_echo_with_invalid_is_served_finally(session):
    session.damage(FRAMING)
    call = session.call(LIFT)
    asked = []
    for _ in range(10):
        request = session.send_next()
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
def test_at_a_disconnect_the_outstanding_call_is_unknown_and_others_not_sent(session,
                                                                             request_):
    sent, waiting, poll = session.call(request_), session.call(LIFT), session.call(AIR, poll=True)
    session.send_next()
    session.master.disconnected(session.now, 'unplugged')
    assert sent.outcome.status == TIMEOUT and 'unplugged' in sent.outcome.message
    assert waiting.outcome.status == poll.outcome.status == NOT_SENT
    assert 'nothing was sent' in waiting.outcome.message


@pytest.mark.parametrize('seen', [True, False], ids=('queued', 'in the inbox'))
def test_no_earlier_call_is_sent_after_a_reconnect(session, seen):
    session.call(LIFT)
    session.send_next()
    session.call(GIMBAL)
    if seen:
        session.later(0.0)
    session.master.disconnected(session.now, 'unplugged')
    session.connect()
    if not session.master.in_step:
        session.get_in_step()
    assert session.send_next() is None


def test_after_a_reconnect_an_echo_is_sent_before_any_call(session):
    """The reply to an earlier call may still arrive, after the reply to SYNC."""
    session.call(LIFT)
    session.send_next()
    session.master.disconnected(session.now, 'unplugged')
    session.master.connected(session.now)
    assert session.next_request() == bus.SYNC_REQUEST
    session.reply(SYNC_REPLY)
    call = session.call(AIR)
    session.get_in_step()
    assert session.next_request() == AIR and call.outcome is None


def test_a_call_submitted_just_before_the_closing_is_refused(session):
    """It is in the inbox, and no `step` has taken it from there."""
    call = session.call(LIFT)
    session.master.disconnected(session.now, 'unplugged')
    assert call.outcome is not None and call.outcome.status == NOT_SENT


def test_a_request_that_the_port_refused_is_reported_as_not_sent(session):
    call = session.call(LIFT)
    session.send_next()
    session.master.not_sent('the port takes no data')
    assert call.outcome.status == NOT_SENT and 'takes no data' in call.outcome.message
    assert session.master.outstanding_call is None


def test_a_repeated_request_that_the_port_refused_was_sent_before(session):
    """The outcome must be true: "nothing was sent" would be wrong."""
    call = session.call(AIR)
    session.send_next()
    session.later(REPLY_TIMEOUT)
    session.get_in_step()
    assert session.send_next() == AIR
    session.master.not_sent('the port takes no data')
    assert call.outcome.status == TIMEOUT


def test_a_repeated_request_that_waits_at_a_disconnect_was_sent_before(session):
    call = session.call(AIR)
    session.send_next()
    session.later(REPLY_TIMEOUT)
    session.master.disconnected(session.now, 'unplugged')
    assert call.outcome.status == TIMEOUT


# -- waiting --------------------------------------------------------------------------------------

def test_a_call_waits_for_the_motion_before_it(session):
    session.call(LIFT)
    session.send_next()
    call = session.call(RAW)
    session.later(MOTION_TIMEOUT - 0.1)
    assert call.outcome is None
    session.reply(OK_REPLY)
    assert session.send_next() == RAW


def test_a_queued_call_expires_without_being_sent(session):
    session.call(LIFT)
    session.send_next()
    session.later(1.0)
    session.call(GIMBAL)
    call = session.call(RAW)
    session.reply(OK_REPLY)
    assert session.send_next() == GIMBAL
    session.later(MOTION_TIMEOUT)
    assert call.outcome.status == NOT_SENT and 'nothing was sent' in call.outcome.message
    while True:
        asked = session.send_next()
        assert asked != RAW
        if asked is None:
            break
        session.reply(bus.Reply(bus.ECHO, asked.data))


def test_a_call_to_a_board_that_never_synchronises_expires_soon(fresh):
    fresh.master.connected(fresh.now)
    fresh.send_next()
    call = fresh.call(LIFT)
    fresh.later(0.0)
    assert fresh.wake_at() <= fresh.now + NOT_READY_WAIT
    fresh.later(REPLY_TIMEOUT)
    fresh.send_next()
    fresh.later(NOT_READY_WAIT)
    assert call.outcome.status == NOT_SENT and 'SYNC' in call.outcome.message


def test_a_call_to_a_silent_board_returns_within_its_timeout_and_a_second(session):
    """While the link is out of step it serves no calls, so they return early."""
    session.call(RAW)
    session.send_next()
    session.later(REPLY_TIMEOUT)
    call, submitted = session.call(bus.Request(bus.FUNCTION, 0x31, b'second')), session.now
    for _ in range(100):
        session.send_next()
        session.later(0.05)
        if call.outcome is not None:
            break
    assert call.outcome.status == NOT_SENT
    assert session.now - submitted <= REPLY_TIMEOUT + 1.0 + 0.1


def test_a_late_unconfirmed_invalid_ends_within_the_timeout_and_a_second(caplog):
    session = Session(caplog, NOT_READY_WAIT).connect()
    session.call(LIFT)
    session.send_next()
    call, submitted = session.call(RAW), session.now
    session.later(NOT_READY_WAIT - 0.1)
    session.reply(OK_REPLY)
    assert session.send_next() == RAW
    session.later(REPLY_TIMEOUT - 0.1)
    session.reply(invalid(0x40))
    while call.outcome is None:
        asked = session.send_next()
        assert asked is None or asked.cmd1 == bus.ECHO
        session.now = session.wake_at()
        session.later(0.0)
    assert call.outcome.status == TIMEOUT
    assert session.now - submitted <= REPLY_TIMEOUT + 1.0


@MOVING_OR_RAW
def test_a_call_whose_caller_has_given_up_is_not_sent(session, request_):
    session.call(LIFT)
    session.send_next()
    call = session.call(request_)
    outcome = call.wait(0.0)
    assert outcome.status == NOT_SENT
    session.reply(OK_REPLY)
    assert session.send_next() is None
    assert call.outcome is outcome


def test_a_call_whose_caller_has_given_up_is_not_sent_again(session):
    call = session.call(LIFT)
    session.send_next()
    outcome = call.wait(0.0)
    assert outcome.status == TIMEOUT and 'not known' in outcome.message
    session.reply(invalid(0x40))
    session.get_in_step()
    assert session.send_next() is None
    assert call.outcome is outcome


def test_the_outcome_of_a_request_sent_while_its_caller_gives_up_is_not_known():
    call = Call(LIFT, bus.LIFT_FUNCTION, 1.0, 1, 0.0)
    lock = call._lock

    class ClaimedFirst:
        """The link's thread holds the lock before the caller does."""

        def __enter__(self):
            call._lock = lock
            assert call.claim()
            lock.acquire()

        def __exit__(self, *_):
            lock.release()

    call._lock = ClaimedFirst()
    outcome = call.wait(0.0)
    assert outcome.status == TIMEOUT and 'not known' in outcome.message
    assert call.outcome is outcome


def test_only_the_first_outcome_counts():
    call = Call(LIFT, bus.LIFT_FUNCTION, 1.0, 1, 0.0)
    first, second = (Outcome(status, '') for status in (NOT_SENT, bus.OK))
    call.finish(first)
    call.finish(second)
    assert call.wait(0.0) is first
    assert not call.claim()


def test_the_deadline_is_that_of_the_request_or_of_a_waiting_call(session):
    session.call(RAW)
    session.send_next()
    session.call(LIFT)
    assert session.wake_at() == pytest.approx(session.now + REPLY_TIMEOUT)


# -- conditions -----------------------------------------------------------------------------------

def test_the_condition_says_why_calls_are_not_served(fresh):
    assert fresh.master.condition() is Condition.SYNCHRONISING
    fresh.connect()
    assert fresh.master.condition() is Condition.READY
    fresh.damage(FRAMING)
    assert fresh.master.condition() is Condition.OUT_OF_STEP
    fresh.send_next()
    fresh.later(REPLY_TIMEOUT)
    assert fresh.master.condition() is Condition.NO_ECHO
    fresh.get_in_step()
    assert fresh.master.condition() is Condition.READY


def test_errors_of_a_bad_line_are_logged_at_a_limited_rate(session):
    for _ in range(100):
        session.damage(FRAMING)
        session.get_in_step()
    assert len(session.warnings('out of step')) == 1


# -- replies that were dropped -----------------------------------------------------------------

def test_after_a_stall_nothing_is_sent_before_an_echo_returns(session):
    session.master.may_have_missed('the bridge stalled', session.now)
    call = session.call(AIR)
    session.get_in_step()
    assert session.next_request() == AIR
    session.reply(AIR_REPLY)
    assert call.outcome.success
    assert len(session.warnings('out of step: the bridge stalled')) == 1


@MOVING_OR_RAW
def test_a_call_succeeds_if_its_reply_arrives_after_a_stall(session, request_):
    call = session.call(request_)
    assert session.send_next() == request_
    session.master.may_have_missed('the bridge stalled', session.now)
    session.reply(OK_REPLY)
    assert call.outcome.success
    session.get_in_step()


@MOVING_OR_RAW
def test_the_outcome_is_unknown_if_the_reply_was_dropped(session, request_):
    call = session.call(request_)
    assert session.send_next() == request_
    session.master.may_have_missed('the bridge stalled', session.now)
    session.later(MOTION_TIMEOUT)
    assert call.outcome.status == TIMEOUT
    session.get_in_step()
    assert session.next_request() is None, 'it is not sent again'


@MOVING_OR_RAW
@pytest.mark.parametrize('code', [bus.CHECKSUM_MISMATCH, bus.NOT_SYNCHRONISED, bus.TOO_LONG])
def test_after_a_stall_an_invalid_makes_the_outcome_unknown(
        session, request_, code):
    call = session.call(request_)
    assert session.send_next() == request_
    session.master.may_have_missed('the bridge stalled', session.now)
    session.reply(invalid(code))
    assert call.outcome.status == TIMEOUT and call.outcome.error_code == code
    assert session.master.synchronised == (code != bus.NOT_SYNCHRONISED)


@MOVING_OR_RAW
def test_a_stall_before_the_confirming_echo_makes_the_outcome_unknown(
        session, request_):
    call = session.call(request_)
    assert session.send_next() == request_
    session.reply(invalid(bus.CHECKSUM_MISMATCH))
    session.master.may_have_missed('the bridge stalled', session.now)
    assert call.outcome.status == TIMEOUT
    session.get_in_step()
    assert session.next_request() is None, 'it is not sent again'


def test_a_reading_is_requested_again_after_a_stall(session):
    call = session.call(AIR)
    assert session.send_next() == AIR
    session.master.may_have_missed('the bridge stalled', session.now)
    session.later(REPLY_TIMEOUT)
    session.get_in_step()
    assert session.next_request() == AIR
    session.reply(AIR_REPLY)
    assert call.outcome.success


def test_a_stall_restarts_the_silence(fresh):
    fresh.connect_without_echo()
    fresh.master.may_have_missed('the bridge stalled', fresh.now)
    assert fresh.next_request() == bus.SYNC_REQUEST
    fresh.reply(SYNC_REPLY)
    fresh.later(REPLY_TIMEOUT * 0.6)
    fresh.master.may_have_missed('the bridge stalled', fresh.now)
    fresh.later(REPLY_TIMEOUT * 0.6)
    assert not fresh.master.in_step and fresh.next_request() is None
    fresh.later(REPLY_TIMEOUT * 0.5)
    assert fresh.master.in_step


# -- 8. interruptions ------------------------------------------------------------------------

def moving(session):
    """A call whose lift is moving."""
    call = session.call(LIFT)
    assert session.send_next() == LIFT
    return call


def test_a_stop_is_sent_during_a_move_whose_outcome_is_then_unknown(session):
    lift = moving(session)
    session.later(1.0)
    stop = session.call(STOP)
    assert session.next_request() == STOP
    assert lift.outcome.status == TIMEOUT and 'not known' in lift.outcome.message
    # The board answers the move, which has just ended or was stopped, and this stop; neither is
    # taken for the reply to a request that has a reply of its own.
    session.reply(OK_REPLY, OK_REPLY)
    assert stop.outcome is None
    session.get_in_step()
    assert session.next_request() == STOP
    session.reply(OK_REPLY)
    assert stop.outcome.success
    assert session.send_next() is None


def test_a_stop_is_not_successful_before_the_board_answers_it_behind_a_fence(session):
    moving(session)
    stop = session.call(STOP)
    assert session.next_request() == STOP
    session.get_in_step()
    assert session.next_request() == STOP
    session.reply(error(bus.UNSUPPORTED))
    assert stop.outcome.status == bus.ERROR and not stop.outcome.success


def test_a_stop_goes_out_again_with_each_echo_until_the_board_answers(session):
    moving(session)
    stop = session.call(STOP)
    for _ in range(ECHO_TRIES):
        assert session.next_request() == STOP
        assert session.next_request().cmd1 == bus.ECHO
        session.later(REPLY_TIMEOUT)
    assert session.next_request() == STOP
    assert session.next_request() == bus.SYNC_REQUEST
    assert stop.outcome is None
    session.later(MOTION_TIMEOUT)
    assert stop.outcome.status == TIMEOUT, 'one of them may have been executed'
    assert session.next_request() == bus.SYNC_REQUEST


def test_a_stop_that_the_port_did_not_take_is_sent_later(session):
    moving(session)
    stop = session.call(STOP)
    assert session.next_request() == STOP
    session.master.not_sent('the port is busy')
    assert session.next_request() == STOP
    session.master.disconnected(session.now, 'unplugged')
    assert stop.outcome.status == TIMEOUT
    session.master.connected(session.now)
    assert session.next_request() == bus.SYNC_REQUEST


def test_a_stop_that_was_sent_at_once_never_counts_as_not_sent(session):
    moving(session)
    stop = session.call(STOP)
    assert session.next_request() == STOP
    assert stop.wait(0.0).status == TIMEOUT


def test_calls_that_wait_are_not_sent_after_a_stop(session):
    moving(session)
    waiting = [session.call(GIMBAL), session.call(AIR, poll=True), session.call(RAW)]
    session.call(STOP)
    after = session.call(LIFT)
    assert session.next_request() == STOP
    assert [call.outcome.status for call in waiting] == [NOT_SENT] * 3
    assert after.outcome is None


def test_a_stop_takes_the_place_of_a_move_that_waits_for_its_fence(session):
    session.call(AIR)
    assert session.send_next() == AIR
    session.reply(AIR_REPLY)
    lift = session.call(LIFT)
    assert session.next_request().cmd1 == bus.ECHO
    stop = session.call(STOP)
    assert session.next_request() == STOP
    assert lift.outcome.status == NOT_SENT
    echo = session.next_request()
    session.reply(bus.Reply(bus.ECHO, session.nonces[-2]), OK_REPLY)
    assert stop.outcome is None and session.next_request() is None
    session.reply(bus.Reply(bus.ECHO, echo.data))
    assert session.next_request() == STOP
    session.reply(OK_REPLY)
    assert stop.outcome.success


@pytest.mark.parametrize('idle', [True, False], ids=('idle', 'moving'))
def test_a_stop_waits_for_nothing_that_is_received(session, idle):
    lift = None if idle else moving(session)
    stop, other = session.call(STOP), session.call(LIFT)
    assert session.master.calls.has_new
    held = 'the rest of an incomplete frame'
    assert session.master.step(session.now, held, port_ready=False)[0] is None
    assert session.master.step(session.now, held)[0] == STOP
    assert idle or lift.outcome.status == TIMEOUT
    assert session.master.step(session.now, held)[0] is None, 'all others wait'
    session.later(MOTION_TIMEOUT)
    session.master.step(session.now, held)
    assert stop.outcome.status == TIMEOUT and other.outcome.status == NOT_SENT


def test_a_call_that_waits_is_told_what_for(session):
    held = 'the rest of an incomplete frame'
    call = session.call(LIFT)
    assert session.master.step(session.now, held)[0] is None
    session.now += MOTION_TIMEOUT
    session.master.step(session.now, held)
    assert call.outcome == (NOT_SENT, f'the link waits for {held}; nothing was sent', 0, b'', 0.0,
                            True, None)


def test_a_stop_is_sent_at_once_while_a_move_with_an_unknown_outcome_may_last(session):
    moving(session)
    session.later(MOTION_TIMEOUT)
    assert session.next_request().cmd1 == bus.ECHO
    session.call(STOP)
    assert session.next_request() == STOP


def test_of_two_stops_both_have_an_outcome(session):
    moving(session)
    stops = [session.call(STOP), session.call(STOP)]
    assert session.next_request() == STOP and session.next_request() == STOP
    session.get_in_step()
    for stop in stops:
        assert session.send_next() == STOP
        session.reply(OK_REPLY)
        assert stop.outcome.success


# -- 10. a move never comes late ---------------------------------------------------------------

@pytest.mark.parametrize('request_', [LIFT, GIMBAL, RAW, CUSTOM, AIR, READ], ids=str)
def test_output_is_dropped_if_a_move_is_not_answered(session, request_):
    session.call(request_, tries=1)
    assert session.send_next() == request_
    sent = session.now
    session.later(MOTION_TIMEOUT)
    assert session.dropped == ([] if request_ in ALL_REPEATABLE else [sent])


# -- 12. another board behind the same port ----------------------------------------------------

def announced(session):
    """A call of an announced function."""
    return session.submit(CUSTOM, reply=bus.ANY_DATA, announced=True)


def test_an_announced_function_is_sent_only_to_a_board_that_has_announced_it(session):
    call = announced(session)
    assert session.next_request() is None and session.begun_anew == []
    assert (call.outcome.status, call.outcome.message) == (
        NOT_SENT, 'the board may have begun anew, and has not announced this function since; '
        'nothing was sent')
    session.announces = True
    call = announced(session)
    assert session.send_next() == CUSTOM


@pytest.mark.parametrize('way', ['unrequested', 'to the call', 'to an ECHO', 'SYNC'])
def test_what_waits_is_not_sent_to_a_board_that_begins_anew(session, way):
    session.announces = True
    if way == 'to the call':
        announced(session)
        assert session.send_next() == CUSTOM
    elif way == 'to an ECHO':
        session.master.may_have_missed('a test', session.now)
        assert session.next_request().cmd1 == bus.ECHO
    elif way == 'SYNC':
        session.call(bus.SYNC_REQUEST)
        assert session.next_request() == bus.SYNC_REQUEST
    waits, lift = announced(session), session.call(LIFT)
    session.reply(SYNC_REPLY if way == 'SYNC' else invalid(0x10))
    assert session.begun_anew == [session.now] and not session.announces
    if way != 'SYNC':
        assert session.next_request() == bus.SYNC_REQUEST
        session.reply(SYNC_REPLY)
        session.get_in_step()
    assert session.send_next() == LIFT
    assert waits.outcome.status == NOT_SENT and lift.outcome is None


def test_an_announced_stop_is_not_sent_to_a_board_that_begins_anew(session):
    session.announces = True
    moving(session)
    session.reply(invalid(0x10))
    stop = session.submit(STOP, repeatable=True, interrupts=True, announced=True)
    assert session.next_request() is None
    assert stop.outcome.status == NOT_SENT
    assert session.next_request() == bus.SYNC_REQUEST
