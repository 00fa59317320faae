"""The Master's session on a robot-ctrl-bus: what may be sent when, and what an answer means.

A state machine without I/O and without a clock: whoever owns the port says what came and what
time it is, and calls `step`, which returns what to send and when to call it again. The rules it
keeps:

1. One request is outstanding, ever. Callers queue; calls go before polls.
2. After a connect, and after INVALID "not synchronised", SYNC until the board answers; nothing
   else is sent before.
3. No reply within its timeout: the request's outcome is unknown.
4. A move done twice is a fault. What moves something, and raw requests, are sent again only
   where a reply said that nothing was executed. What merely reads is repeatable: it may be sent
   again after any try.
   A board may also send INVALID for noise, and execute the request behind it: before a call is
   sent again or reported as refused, an ECHO must return. If an OK arrives before that ECHO, the
   outcome is unknown.
5. A request for which no data is expected may be answered with data in the OK. Behind a fence it
   is this request's answer, whatever it carries; from a board that never echoes it is taken for
   another request's reply.
   Any other OK with the wrong number of data bytes, or with values that cannot be, is reported
   as that: at once behind a fence, else a poll is sent once more behind the ECHO.
6. Replies carry no number, so one that is late or doubled could be taken for the next request's.
   A line keeps its order: what was under way arrives before the reply to a later ECHO.
   So before every request stands a fence: an ECHO with a fresh nonce has returned since the last
   byte of the exchange before. Only SYNC and ECHO need none, nor does a poll where the exchange
   before it was the same request, byte for byte: then the reply is of the same kind at least.
   After a SYNC, a timeout, a damaged reply, one of a wrong length or one that nobody asked for,
   the link is out of step: nothing at all goes out before such an ECHO, and whatever comes
   before it returns is dropped.
   Where `ECHO_TRIES` ECHOs in a row are not answered, a SYNC and a silence of the reply timeout
   take the place of one. A board that has never echoed gets a silence of `QUIET` as its fence.
7. What a caller is told is true. Success: executed, exactly once (a repeatable request: by the
   try that was answered). Refused or not sent: not executed (a repeatable one: not by its last
   try). Timeout: unknown, executed once or not at all.
"""
import enum
import os
import threading
from collections import deque
from dataclasses import dataclass
from typing import Any, Callable, Deque, List, Optional, Tuple

from ...framing.layout import Layout
from ...framing.stream import CHECKSUM, Frame
from ...link.outcome import LOOK, NOT_SENT, TIMEOUT, Outcome
from ...link.sparing_log import SparingLog
from . import wire

ECHO_TRIES = 3     # unanswered ECHOs before a SYNC and a silence take their place
QUIET = 0.02       # s of silence as a fence: a USB adapter hands bytes over up to 16 ms late
PATIENCE = 0.8     # s that a call waits for a link that serves nobody

_UNKNOWN = f'it is not known whether this was executed; {LOOK}'


class Call:
    """One request on its way, shared by the caller, who waits, and the link, which serves it.

    Args:
        request: what to ask.
        timeout: s from sending to the reply.
        repeatable: whether it may be sent again when its outcome is unknown.
        tries: how often it may be sent in all.
        now: the time of the call.
        poll: nobody waits for it: every other call goes first.
        reply_layout: what data its OK must have; None: any. Of one that is empty see rule 5.
        on_success: is called in the link's thread with a successful outcome.
    """

    def __init__(self, request: wire.Request, timeout: float, repeatable: bool, tries: int,
                 now: float, poll: bool = False, reply_layout: Optional[Layout] = None,
                 on_success: Optional[Callable[[Outcome], None]] = None) -> None:
        self.request = request
        self.timeout = timeout
        self.repeatable = repeatable
        self.tries = tries
        self.submitted = now
        self.poll = poll
        self.reply_layout = reply_layout
        self.on_success = on_success
        self.last_try: Optional[Outcome] = None   # how the try before this one ended
        # Whether the INVALID that ended that try may have been said of noise. An ECHO that
        # returns with no other reply before it confirms that it was said of this request.
        self.invalid_unconfirmed = False
        self.expires = float('inf')     # while it waits: when its turn must have come
        self.outcome: Optional[Outcome] = None
        self._sent = False
        self._lock = threading.Lock()
        self._done = threading.Event()

    @property
    def always_fenced(self) -> bool:
        """Whether it needs a fence whatever was exchanged before; see rule 6."""
        is_probe = self.repeatable and self.request.cmd1 in (wire.SYNC, wire.ECHO)
        return not (self.poll or is_probe)

    def claim(self) -> bool:
        """Before each sending: whether the caller still wants it."""
        with self._lock:
            if self.outcome is None:
                self._sent = True
                self.tries -= 1
            return self.outcome is None

    def finish(self, outcome: Outcome) -> None:
        """Tell the caller. The first word stands."""
        with self._lock:
            if self.outcome is None:
                self.outcome = outcome
        self._done.set()

    def wait(self, seconds: float) -> Outcome:
        """Sleep until it is finished, `seconds` at most; from then on it is never sent."""
        if not self._done.wait(seconds):
            self.finish(Outcome(TIMEOUT, f'the bridge is stuck: {_UNKNOWN}') if self._sent else
                        Outcome(NOT_SENT, 'the bridge is stuck; nothing was sent'))
        return self.outcome


class State(enum.Enum):
    """What may be sent next."""

    CLOSED = 'nothing: the port is closed'
    UNSYNCHRONISED = 'SYNC'
    OUT_OF_STEP = 'ECHO: a reply may still be under way'
    IN_STEP = 'SYNC, ECHO and the same poll again; an ECHO as a fence before others'
    FENCED = 'any request: nothing can be under way'


class Condition(enum.Enum):
    """What is amiss with the board, in a few words."""

    READY = ''
    SYNCHRONISING = 'synchronising'
    NO_SYNC = 'the board does not answer SYNC'
    OUT_OF_STEP = 'out of step'
    NO_ECHO = 'the board does not answer ECHO'


class _Kind(enum.Enum):
    """What is outstanding."""

    SYNC = 'a SYNC of the Master itself'
    ECHO = 'an ECHO of the Master itself'
    SILENCE = 'a silence in the place of an ECHO'
    CALL = 'the request of a call'


@dataclass
class _Exchange:
    """The request that is outstanding."""

    kind: _Kind
    request: wire.Request
    sent: float
    deadline: float
    call: Optional[Call] = None
    fenced: bool = False                      # no reply of before can come any more
    other_reply: Optional[wire.Reply] = None   # the latest that cannot be its own
    missed: bool = False                      # its reply may have come, and nobody has seen it


class Master:
    """See the module. All times are seconds of one monotonic clock.

    Args:
        reply_timeout: for SYNC and ECHO.
        motion_timeout: the longest that any call may take; how long others wait for their turn.
        log: for what a person should know.
        nonce: gives fresh bytes for an ECHO.
    """

    def __init__(self, reply_timeout: float, motion_timeout: float, log: SparingLog,
                 nonce: Callable[[], bytes] = lambda: os.urandom(4)) -> None:
        self.state = State.CLOSED
        self.timeouts = 0
        self.length_errors = 0
        self.implausible = 0
        self.round_trips: Deque[float] = deque(maxlen=200)
        self._reply_timeout = reply_timeout
        self._longest_turn = max(motion_timeout, PATIENCE)
        self._log = log
        self._nonce = nonce
        self._submitted: Deque[Call] = deque()  # from other threads
        self._calls: Deque[Call] = deque()
        self._polls: Deque[Call] = deque()
        self._retry: Optional[Call] = None      # a call that is sent again goes first
        self._exchange: Optional[_Exchange] = None
        self._latest_request: Optional[wire.Request] = None     # the one sent last
        self._served_until = 0.0                # when the latest call's exchange ended
        self._last_received = 0.0               # when the latest bytes came
        self._unanswered_syncs = 0
        self._unanswered_echoes = 0
        self._has_echoed = False                # since the port opened
        self._reply_handlers = {
            _Kind.SYNC: self._sync_answered, _Kind.ECHO: self._echo_answered,
            _Kind.SILENCE: self._silence_broken, _Kind.CALL: self._call_answered}
        self._timeout_handlers = {
            _Kind.SYNC: self._sync_timed_out, _Kind.ECHO: self._echo_timed_out,
            _Kind.SILENCE: self._silence_kept, _Kind.CALL: self._call_timed_out}

    # -- calls ------------------------------------------------------------------------

    def submit(self, call: Call) -> None:
        """Queue a call; any thread. The outcome arrives in the call."""
        self._submitted.append(call)

    # -- what happened ------------------------------------------------------------------

    def connected(self, now: float) -> None:
        """The port is open: nothing is known of the board."""
        self.state = State.UNSYNCHRONISED
        self._has_echoed = False
        self._unanswered_echoes = 0
        self._unanswered_syncs = 0
        self._last_received = now

    def disconnected(self, now: float, why: str) -> None:
        """The port has closed: every call returns."""
        self.state = State.CLOSED
        exchange, self._exchange = self._exchange, None
        if exchange is not None and exchange.call:
            exchange.call.finish(Outcome(
                TIMEOUT, f'the port closed before the reply came ({why}): {_UNKNOWN}'))
        self._queue_submitted()

    def received(self, frame: Frame, now: float) -> None:
        """A valid reply has come."""
        self._last_received = now
        exchange, reply = self._exchange, frame.message
        if reply.cmd1 == wire.ECHO:      # however late it comes
            self._has_echoed = True
        if self._retry is not None and _may_be_behind_the_invalid(reply, self._retry):
            # Either the INVALID was for noise and this is the reply, or this is another's.
            call, self._retry = self._retry, None
            call.finish(_unknown_after_invalid(call.last_try))
        elif exchange is None or (exchange.kind is _Kind.SILENCE and _lost_synchronism(reply)):
            self._exchange = None
            self._out_of_step(f'a reply that nobody asked for: {reply}')
            if _lost_synchronism(reply):
                self.state = State.UNSYNCHRONISED
        else:
            self._reply_handlers[exchange.kind](exchange, frame, now)

    def damaged(self, frame: Frame, now: float) -> None:
        """Bytes have come that are no valid reply."""
        self._last_received = now
        exchange = self._exchange
        if exchange is not None and exchange.kind is _Kind.SILENCE:
            self._expect_silence(now)
            return
        self._out_of_step('damaged bytes')
        if exchange is not None and exchange.kind is _Kind.CALL and frame.cause == CHECKSUM:
            # It has the form of a reply. Plain noise may come while a motion lasts, and the
            # reply behind it is good: for that, wait on.
            self._repeat_or_finish(exchange, now, Outcome(
                TIMEOUT, f'the reply was damaged: {_UNKNOWN}'))

    def missed(self, why: str, now: float) -> None:
        """Replies may have come that nobody has seen."""
        self._last_received = now
        self._out_of_step(why)
        exchange = self._exchange
        if exchange is not None:
            exchange.missed = True
            if exchange.kind is _Kind.SILENCE:
                self._expect_silence(now)
        if self._retry is not None and self._retry.invalid_unconfirmed:
            # One of them may have told that the INVALID was said of noise.
            call, self._retry = self._retry, None
            call.finish(_unknown_after_invalid(call.last_try))

    # -- what to do ---------------------------------------------------------------------

    def step(self, now: float,
             may_send: bool = True) -> Tuple[Optional[wire.Request], Optional[float]]:
        """Do what is due by time.

        Args:
            may_send: False: nothing can leave the port now.

        Returns:
            The request to send now, which is outstanding from here on, or None; and when to call
            this again at the latest, or None.
        """
        self._queue_submitted()
        exchange = self._exchange
        if exchange is not None and now >= exchange.deadline:
            self._exchange = None
            self._timeout_handlers[exchange.kind](exchange, now)
        self._abandon_overdue(now)
        request, quiet_until = self._next_request(now) if may_send else (None, None)
        times = [self._expiry(call) for call in self._waiting()]
        if quiet_until is not None:
            times.append(quiet_until)
        if self._exchange is not None:
            times.append(self._exchange.deadline)
        return request, min(times, default=None)

    @property
    def synchronised(self) -> bool:
        """Whether the board has answered SYNC, and has not forgotten it since."""
        return self.state not in (State.CLOSED, State.UNSYNCHRONISED)

    @property
    def in_step(self) -> bool:
        """Whether requests of calls may be sent."""
        return self.state in (State.IN_STEP, State.FENCED)

    @property
    def asked(self) -> Optional[wire.Request]:
        """What is outstanding."""
        return self._exchange.request if self._exchange else None

    def condition(self) -> Condition:
        """What is amiss with the board."""
        if not self.synchronised:
            return Condition.NO_SYNC if self._unanswered_syncs else Condition.SYNCHRONISING
        if not self.in_step:
            return Condition.NO_ECHO if self._unanswered_echoes else Condition.OUT_OF_STEP
        return Condition.READY

    def not_sent(self, why: str) -> None:
        """The request that `step` returned did not leave the port."""
        exchange, self._exchange = self._exchange, None
        if exchange is not None and exchange.call:
            exchange.call.finish(exchange.call.last_try
                                 or Outcome(NOT_SENT, f'{why}; nothing was sent'))

    # -- fences -------------------------------------------------------------------------

    @property
    def _never_echoes(self) -> bool:
        """Whether this board seems to know no ECHO."""
        return not self._has_echoed and self._unanswered_echoes >= ECHO_TRIES

    def _needs_fence(self, call: Call) -> bool:
        """Whether a reply to the request before it could seem to answer it."""
        return call.always_fenced or (call.poll and call.request != self._latest_request)

    def _out_of_step(self, why: str) -> None:
        if self.in_step:
            self._log.warn('out of step', f'out of step: {why}; finding it again with an ECHO')
        if self.synchronised:
            self.state = State.OUT_OF_STEP

    # -- sending ------------------------------------------------------------------------

    def _next_request(self, now: float) -> Tuple[Optional[wire.Request], Optional[float]]:
        """The request to send now; or until when there has to be silence before the next one."""
        if self._exchange is not None or self.state is State.CLOSED:
            return None, None
        if not self.synchronised:
            return self._send(_Kind.SYNC, wire.SYNC_REQUEST, now), None
        if not self.in_step:
            return (self._send_echo(now) if self._unanswered_echoes < ECHO_TRIES else
                    self._send(_Kind.SYNC, wire.SYNC_REQUEST, now)), None
        while True:
            call = self._next_call()
            if call is None:
                return None, None
            if call.tries and self._needs_fence(call):
                if not self._never_echoes and self.state is not State.FENCED:
                    return self._send_echo(now), None
                if self._never_echoes and now < self._last_received + QUIET:
                    return None, self._last_received + QUIET
            self._remove(call)
            if not call.tries:      # all that it waited for was what its last try meant
                call.finish(call.last_try)
            elif call.claim():
                return self._send_call(call, now), None

    def _send_echo(self, now: float) -> wire.Request:
        return self._send(_Kind.ECHO, wire.echo(self._nonce()), now)

    def _send(self, kind: _Kind, request: wire.Request, now: float) -> wire.Request:
        return self._begin(_Exchange(kind, request, now, now + self._reply_timeout))

    def _send_call(self, call: Call, now: float) -> wire.Request:
        call.invalid_unconfirmed = False
        fenced = self.state is State.FENCED
        self.state = State.IN_STEP
        return self._begin(_Exchange(_Kind.CALL, call.request, now, now + call.timeout, call,
                                     fenced))

    def _begin(self, exchange: _Exchange) -> wire.Request:
        self._exchange = exchange
        self._latest_request = exchange.request
        return exchange.request

    def _expect_silence(self, now: float) -> None:
        self._send(_Kind.SILENCE, wire.SYNC_REQUEST, now)

    # -- replies ------------------------------------------------------------------------

    def _sync_answered(self, _exchange: _Exchange, frame: Frame, now: float) -> None:
        reply = frame.message
        if reply.cmd1 == wire.SYNC:
            self._exchange = None
            self._unanswered_syncs = 0
            self.state = State.OUT_OF_STEP
            if self._unanswered_echoes >= ECHO_TRIES:
                self._expect_silence(now)
        elif reply.cmd1 != wire.INVALID:     # INVALID: damaged on the way; asked again in time
            self._out_of_step(f'{reply} to SYNC')

    def _echo_answered(self, exchange: _Exchange, frame: Frame, _now: float) -> None:
        reply = frame.message
        if reply.cmd1 == wire.ECHO and reply.data == exchange.request.data:
            self._exchange = None
            self._unanswered_echoes = 0
            self.state = State.FENCED
        elif _lost_synchronism(reply):
            self._exchange = None
            self._echo_unanswered()
            self.state = State.UNSYNCHRONISED
        else:
            self._out_of_step(f'{reply} to ECHO')

    def _silence_broken(self, _exchange: _Exchange, _frame: Frame, now: float) -> None:
        self._expect_silence(now)

    def _call_answered(self, exchange: _Exchange, frame: Frame, now: float) -> None:
        reply, request, call = frame.message, exchange.request, exchange.call
        if not self._answers(reply, call):
            # Somebody else's, or an echo of other bytes. The right one may still come.
            exchange.other_reply = reply
            self._out_of_step(f'{reply} to {request}')
            return
        objection = self._objection(reply, call) if reply.cmd1 == wire.OK else ''
        if objection:
            self._unexpected(exchange, frame, objection, now)
            return
        round_trip = now - exchange.sent
        self.round_trips.append(round_trip)
        outcome = _outcome_of(reply, request, round_trip, frame.stamp)
        if reply.cmd1 == wire.ECHO:
            self._unanswered_echoes = 0
        if reply.cmd1 != wire.INVALID:
            self._finish(exchange, now, outcome)
            return
        if exchange.missed and call.always_fenced:     # then this may be said of noise behind it
            if _lost_synchronism(reply):
                self.state = State.UNSYNCHRONISED
            self._finish(exchange, now, _unknown_after_invalid(outcome))
            return
        code = reply.error_code
        if code not in (wire.NOT_SYNCHRONISED, wire.CHECKSUM_MISMATCH):
            call.tries = 0
        if code == wire.NOT_SYNCHRONISED:
            self.state = State.UNSYNCHRONISED
        elif call.always_fenced:
            call.invalid_unconfirmed = True
            self.state = State.OUT_OF_STEP
            self._send_again(exchange, now, outcome)
            return
        if call.tries:
            self._send_again(exchange, now, outcome)
        else:
            self._finish(exchange, now, outcome)

    def _answers(self, reply: wire.Reply, call: Call) -> bool:
        """Whether this can be the reply to that."""
        layout = call.reply_layout
        if (self._never_echoes and reply.cmd1 == wire.OK and reply.data
                and layout is not None and layout.is_empty):
            return False     # without a fence it may be another request's
        return _may_answer(reply, call.request)

    def _objection(self, reply: wire.Reply, call: Call) -> str:
        """What is wrong with the data of an OK, or ''. It is counted."""
        layout, size = call.reply_layout, len(reply.data)
        if layout is None or layout.is_empty:
            return ''
        if not layout.fits(size):
            self.length_errors += 1
            return f'{size} bytes of data, {layout.sizes()} were expected'
        reason = layout.implausible(layout.unpack(reply.data))
        if reason:
            self.implausible += 1
        return reason

    def _unexpected(self, exchange: _Exchange, frame: Frame, objection: str, now: float) -> None:
        """An OK with data that the call does not expect."""
        data, call = frame.message.data, exchange.call
        text = (f'the board answered "{exchange.request}" with {objection}; does its firmware '
                'know another form of it?')
        self._log.warn('unexpected', text)
        self.state = State.OUT_OF_STEP
        exchange.other_reply = frame.message
        outcome = Outcome(wire.OK, text, 0, data, now - exchange.sent, False, frame.stamp)
        if exchange.fenced:
            self._finish(exchange, now, outcome)
        elif call.repeatable:
            self._repeat_or_finish(exchange, now, outcome)
        # Otherwise the board never echoes: the right one may still come.

    # -- timeouts -----------------------------------------------------------------------

    def _sync_timed_out(self, _exchange: _Exchange, _now: float) -> None:
        self.timeouts += 1
        self.state = State.UNSYNCHRONISED
        self._unanswered_syncs += 1

    def _echo_timed_out(self, _exchange: _Exchange, _now: float) -> None:
        self.timeouts += 1
        self.state = State.OUT_OF_STEP
        self._echo_unanswered()

    def _echo_unanswered(self) -> None:
        self._unanswered_echoes += 1
        if self._unanswered_echoes == ECHO_TRIES:
            self._log.warn('no echo', 'the board does not answer ECHO; a SYNC and '
                           f'{self._reply_timeout:g} s of silence take its place')

    def _silence_kept(self, _exchange: _Exchange, _now: float) -> None:
        self.state = State.FENCED
        if self._has_echoed:        # three lost ones were bad luck: it is asked again
            self._unanswered_echoes = 0

    def _call_timed_out(self, exchange: _Exchange, now: float) -> None:
        self.timeouts += 1
        within = f'within {exchange.call.timeout:g} s'
        if exchange.other_reply is not None:
            within += f' but {exchange.other_reply}, which may be to another request'
        self._log.warn('timeout', f'no reply to "{exchange.request}" {within}')
        self._out_of_step('no reply')
        self._repeat_or_finish(exchange, now, Outcome(TIMEOUT, f'no reply {within}: {_UNKNOWN}'))

    # -- the end of an exchange -----------------------------------------------------------

    def _repeat_or_finish(self, exchange: _Exchange, now: float, outcome: Outcome) -> None:
        """After a try whose outcome is unknown."""
        if exchange.call.repeatable and exchange.call.tries:
            self._send_again(exchange, now, outcome)
        else:
            self._finish(exchange, now, outcome)

    def _send_again(self, exchange: _Exchange, now: float, outcome: Outcome) -> None:
        """Put the call back: first of all calls, but a poll behind every call."""
        self._exchange = None
        self._served_until = now
        call = exchange.call
        call.last_try = outcome
        call.expires = now + self._longest_turn
        if call.invalid_unconfirmed:    # its caller waits for the ECHO behind that alone
            call.expires = min(now + max(call.timeout, PATIENCE),
                               call.submitted + self._longest_turn + call.timeout)
        if call.poll:
            self._polls.appendleft(call)
        else:
            self._retry = call

    def _finish(self, exchange: _Exchange, now: float, outcome: Outcome) -> None:
        self._exchange = None
        self._served_until = now
        call = exchange.call
        call.finish(outcome)
        if outcome.success and call.on_success:
            call.on_success(outcome)

    # -- calls that wait ------------------------------------------------------------------

    def _next_call(self) -> Optional[Call]:
        """The one that is served next."""
        if self._retry is not None:
            return self._retry
        waiting = self._calls or self._polls
        return waiting[0] if waiting else None

    def _waiting(self) -> List[Call]:
        waiting = list(self._calls) + list(self._polls)
        if self._retry is not None:
            waiting.append(self._retry)
        return waiting

    def _queue_submitted(self) -> None:
        while self._submitted:
            call = self._submitted.popleft()
            call.expires = call.submitted + self._longest_turn
            (self._polls if call.poll else self._calls).append(call)
        if self.state is State.CLOSED:
            for call in self._waiting():
                self._abandon(call, 'the port is closed')

    def _remove(self, call: Call) -> None:
        if call is self._retry:
            self._retry = None
            return
        for queue in (self._calls, self._polls):
            try:
                queue.remove(call)
            except ValueError:
                pass

    def _expiry(self, call: Call) -> float:
        """When a call that waits returns that it was not sent, or not sent again.

        Sooner while the link serves nobody. But an ECHO may be answered only after what the board
        is busy with: a move, say.
        """
        exchange = self._exchange
        if self.in_step or (exchange is not None and exchange.kind is _Kind.CALL):
            return call.expires
        patience = max(PATIENCE, call.timeout) if self.synchronised else PATIENCE
        return min(call.expires, max(call.submitted, self._served_until) + patience)

    def _abandon_overdue(self, now: float) -> None:
        for call in self._waiting():
            if call.outcome is not None:      # its caller has gone
                self._remove(call)
            elif now >= self._expiry(call):
                self._abandon(call, self.condition().value or 'the bus is busy with other calls')

    def _abandon(self, call: Call, why: str) -> None:
        """A call that waits is not sent, or not sent again."""
        self._remove(call)
        if call.invalid_unconfirmed:
            call.finish(_unknown_after_invalid(call.last_try))
        elif call.last_try:
            call.finish(call.last_try)
        elif call.request == wire.SYNC_REQUEST:
            call.finish(Outcome(NOT_SENT, why))     # a SYNC of the link's own may have left
        else:
            call.finish(Outcome(NOT_SENT, f'{why}; nothing was sent'))


def _lost_synchronism(reply: wire.Reply) -> bool:
    return reply.cmd1 == wire.INVALID and reply.error_code == wire.NOT_SYNCHRONISED


def _may_answer(reply: wire.Reply, request: wire.Request) -> bool:
    """Whether a reply of this type can be to that request."""
    if reply.cmd1 in (wire.ERROR, wire.INVALID):
        return True
    if request.cmd1 == wire.ECHO:
        return reply.cmd1 == wire.ECHO and reply.data == request.data
    if request.cmd1 == wire.SYNC:
        return reply.cmd1 == wire.SYNC
    return reply.cmd1 == wire.OK


def _may_be_behind_the_invalid(reply: wire.Reply, call: Call) -> bool:
    """Whether this may tell that a request which got an INVALID was executed all the same.

    It does not matter where the call is sent again anyway.
    """
    return (call.invalid_unconfirmed and not (call.repeatable and call.tries)
            and reply.cmd1 not in (wire.ERROR, wire.INVALID) and _may_answer(reply, call.request))


def _unknown_after_invalid(invalid: Outcome) -> Outcome:
    """Of an INVALID that may have been said of noise before the request."""
    return Outcome(TIMEOUT, f'the board said INVALID ({wire.describe_error(invalid.error_code)}), '
                   f'perhaps of noise on the line: {_UNKNOWN}', invalid.error_code)


def _outcome_of(reply: wire.Reply, request: wire.Request, round_trip: float,
                stamp: Any) -> Outcome:
    """The outcome that a reply means."""
    code = reply.error_code
    if reply.cmd1 == wire.INVALID:
        message = f'refused, nothing was executed: {wire.describe_error(code)}'
    elif reply.cmd1 == wire.ERROR:
        message = f'the board refused: {wire.describe_error(code)}'
    else:
        message = f'done: {request}'
    return Outcome(reply.cmd1, message, code, reply.data, round_trip, True, stamp)
