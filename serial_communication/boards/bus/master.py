"""The Master's session on a robot-ctrl-bus: which request may be sent when, and what a reply means.

A state machine without I/O and without a clock. The link, which owns the port, reports what it
received and at what time, and calls `step`, which returns the request to send and the time of the
next call. The rules:

1. At most one request is outstanding. Callers queue; calls go before polls.
2. After a connect, and after INVALID "not synchronised", the Master sends SYNC until the board
   replies, and nothing else before.
3. If no reply arrives within the timeout, the request's outcome is unknown.
4. A move that is executed twice is a fault. Moves and raw requests are sent again only after a
   reply which means that nothing was executed. Requests that only read are repeatable: they may
   be sent again after any try.
   A board may also send INVALID, with any code, because of noise, and then execute the request
   after the noise. So an ECHO must return before a call is sent again or reported as refused. If an
   OK arrives before that ECHO, or bytes that are no valid reply, the outcome is unknown.
5. A board may put data into its OK to a request that expects none. Behind a fence it is the reply
   to this request, whatever data it has. From a board that never echoes it counts as another
   request's reply.
   Any other OK with the wrong number of data bytes, or with impossible values, is reported as
   such: at once behind a fence; without a fence, a poll is first sent again, behind one.
6. Replies have no number, so a late or doubled one could be taken for the reply to the next
   request. But a line keeps the order: a reply that is under way arrives before the reply to a
   later ECHO. So there is a fence before every request: an ECHO with a new nonce has returned
   since the last byte of the exchange before. SYNC and ECHO need no fence. Nor does a poll if the
   exchange before was the same request, byte for byte: a late reply has the same meaning.
   After a SYNC, a timeout, a damaged reply, a reply of a wrong length, or a reply that was not
   requested, the link is out of step: nothing is sent before such an ECHO, and everything received
   before it returns is dropped.
   After `ECHO_TRIES` unanswered ECHOs in a row, a SYNC and a silence of the reply timeout replace
   the ECHO. For a board that has never echoed, a silence of `FENCE_SILENCE` is the fence.
7. The reported outcome is always true. Success: executed exactly once. Refused or not sent: not
   executed. Timeout: unknown, executed once or not at all. A repeatable request may have been
   executed in earlier tries, too: its outcome describes the last try.
8. A call that interrupts, a stop, is the exception to rules 1 and 6. It is sent at once, whatever
   is being received: only a port that takes no data holds it. Calls that wait are not sent. If a
   request of a call is outstanding, its outcome is unknown. The stop is sent again after each
   unanswered ECHO or SYNC. All replies are dropped until an ECHO returns. Then the stop is sent in
   its turn like any repeatable request, and the reply to that is its outcome.
9. What may have waited while the bridge stalled is not sent, unless it is repeatable. The link
   refuses such calls; those that waited here already are given up when the stall is reported.
10. A move is not executed late. Its fence is at most `FENCE_AGE` old, so the board was heard just
   before. If nothing at all was received since a request that is not repeatable, and it times out,
   it may still wait in the port: it is dropped there. Readings are not dropped: a network
   connection would have to be closed for each poll of a silent board.
11. A board answers in the order of the requests, also while it moves. Rule 6 needs that, and
   nothing here can detect a board that does not.
12. A board that answers SYNC, or replies "not synchronised", may have begun anew, or be another
   one. What it announced counts no more: an announced function is not sent before it is announced
   again.
"""
import enum
import os
import threading
from collections import deque
from dataclasses import dataclass
from typing import Any, Callable, Deque, Dict, List, Optional, Tuple

from ...framing.layout import Layout
from ...framing.stream import CHECKSUM, Frame
from ...link.outcome import LOOK, NOT_SENT, TIMEOUT, Outcome
from ...link.sparing_log import SparingLog
from . import wire

ECHO_TRIES = 3         # unanswered ECHOs before a SYNC and a silence replace them
FENCE_SILENCE = 0.02   # s of silence as a fence: a USB adapter delivers bytes up to 16 ms late
FENCE_AGE = 1.0        # s; before a move, an older fence is renewed
NOT_READY_WAIT = 0.8   # s that a call waits while the link is not ready

STALLED = 'it may have waited while the bridge stalled'
_NOT_ANNOUNCED = 'the board may have begun anew, and has not announced this function since'
_UNKNOWN = f'it is not known whether this was executed; {LOOK}'
_NOT_TRIED = Outcome(NOT_SENT, 'nothing was sent')


class Call:
    """One request and its outcome, shared by the caller, who waits, and the link, which sends it.

    Args:
        request: the request.
        timeout: s from sending to the reply.
        repeatable: whether it may be sent again if its outcome is unknown.
        tries: how often it may be sent in all.
        now: the time of the call.
        poll: whether it is a poll, which is sent only when no other call waits.
        reply_layout: layout of the data in its OK; None: any data; empty: see rule 5.
        on_success: called in the link's thread with a successful outcome.
        interrupts: whether it is sent at once, whatever is outstanding; see rule 8.
        announced: whether it is sent only to a board that has announced it; see rule 12.
    """

    def __init__(self, request: wire.Request, timeout: float, repeatable: bool, tries: int,
                 now: float, poll: bool = False, reply_layout: Optional[Layout] = None,
                 on_success: Optional[Callable[[Outcome], None]] = None,
                 interrupts: bool = False, announced: bool = False) -> None:
        self.request = request
        self.timeout = timeout
        self.repeatable = repeatable
        self.tries = tries
        self.submitted = now
        self.poll = poll
        self.reply_layout = reply_layout
        self.on_success = on_success
        self.interrupts = interrupts
        self.announced = announced
        self.last_try = _NOT_TRIED      # outcome of the try before this one
        # Whether the last try ended with an INVALID that the board may have sent because of noise.
        # An ECHO that returns before any other reply confirms that it was for this request.
        self.invalid_unconfirmed = False
        self.expires = float('inf')     # when it is given up if it still waits
        self.outcome: Optional[Outcome] = None
        self._sent = False
        self._lock = threading.Lock()
        self._done = threading.Event()

    @property
    def always_fenced(self) -> bool:
        """Whether it needs a fence whatever the exchange before was; see rule 6."""
        is_probe = self.repeatable and self.request.cmd1 in (wire.SYNC, wire.ECHO)
        return not (self.poll or is_probe)

    @property
    def needs_confirmation(self) -> bool:
        """Whether its INVALID has to be confirmed; not if it is sent again anyway."""
        return self.invalid_unconfirmed and not (self.repeatable and self.tries)

    def claim(self, tries: int = 1) -> bool:
        """Count a try; False if the caller has given up, so it must not be sent."""
        with self._lock:
            if self.outcome is None:
                self._sent = True
                self.tries -= tries
            return self.outcome is None

    def finish(self, outcome: Outcome) -> None:
        """Set the outcome and wake the caller; only the first outcome counts."""
        with self._lock:
            if self.outcome is None:
                self.outcome = outcome
        self._done.set()

    def wait(self, seconds: float) -> Outcome:
        """Wait for the outcome, at most `seconds`; after that the request is never sent."""
        self._done.wait(seconds)
        with self._lock:        # so that it is not claimed, and then sent, meanwhile
            if self.outcome is None:
                self.outcome = Outcome(TIMEOUT, f'the bridge is stuck: {_UNKNOWN}') if self._sent \
                    else Outcome(NOT_SENT, 'the bridge is stuck; nothing was sent')
            return self.outcome


class SessionState(enum.Enum):
    """What may be sent next."""

    CLOSED = 'nothing: the port is closed'
    UNSYNCHRONISED = 'SYNC'
    OUT_OF_STEP = 'ECHO: a reply may still be under way'
    IN_STEP = 'SYNC, ECHO, or the same poll again; before any other request, an ECHO as a fence'
    FENCED = 'any request: no reply can be under way'


class Condition(enum.Enum):
    """Why the link cannot serve calls, for diagnostics; '' if it can."""

    READY = ''
    SYNCHRONISING = 'synchronising'
    NO_SYNC = 'the board does not answer SYNC'
    OUT_OF_STEP = 'out of step'
    NO_ECHO = 'the board does not answer ECHO'


class _Kind(enum.Enum):
    """The kind of an exchange."""

    SYNC = 'a SYNC of the Master itself'
    ECHO = 'an ECHO of the Master itself'
    SILENCE = 'a silence that replaces an ECHO'
    CALL = 'the request of a call'


@dataclass
class _Exchange:
    """The outstanding request, or a silence."""

    kind: _Kind
    request: wire.Request
    sent: float
    deadline: float


@dataclass
class _CallExchange(_Exchange):
    """The outstanding request of a call."""

    call: Call
    fenced: bool                               # no reply to an earlier request can arrive
    other_reply: Optional[wire.Reply] = None   # the latest reply that cannot be for this request
    reply_may_be_lost: bool = False            # the reply may have been received and dropped


class Master:
    """See the module. All times are in s of one monotonic clock.

    Args:
        reply_timeout: s; for SYNC and ECHO.
        motion_timeout: s; the longest timeout of a call, and so the longest wait for a turn.
        log: for warnings.
        nonce: returns new bytes for an ECHO.
        drop_output: called with the time when a request was sent that was not answered: drops what
            may still wait on its way; see rule 10.
        begun_anew: called with the time when the board may have begun anew, or be another one.
        still_announces: whether the board has announced the announced functions since then.
    """

    def __init__(self, reply_timeout: float, motion_timeout: float, log: SparingLog,
                 nonce: Callable[[], bytes] = lambda: os.urandom(4),
                 drop_output: Callable[[float], None] = lambda sent: None,
                 begun_anew: Callable[[float], None] = lambda now: None,
                 still_announces: Callable[[], bool] = lambda: True) -> None:
        self.state = SessionState.CLOSED
        self.timeouts = 0
        self.length_errors = 0
        self.implausible = 0
        self.round_trips: Deque[float] = deque(maxlen=200)     # s; the latest
        self._reply_timeout = reply_timeout
        self._longest_wait = max(motion_timeout, NOT_READY_WAIT)
        self._log = log
        self._nonce = nonce
        self._drop_output = drop_output
        self._begun_anew = begun_anew
        self._still_announces = still_announces
        self._submitted: Deque[Call] = deque()  # from other threads
        self._calls: Deque[Call] = deque()
        self._polls: Deque[Call] = deque()
        self._retry: Optional[Call] = None      # the call to send again, before all others
        self._at_once: List[Call] = []          # to be sent now, whatever is outstanding
        self._waits_for = ''                    # see `step`
        self._exchange: Optional[_Exchange] = None
        self._latest_request: Optional[wire.Request] = None
        self._served_until = 0.0                # when the exchange of the latest call ended
        self._fenced_at = 0.0                   # when the latest fence was complete
        self._last_received = 0.0               # when the latest bytes were received
        self._unanswered_syncs = 0
        self._unanswered_echoes = 0
        self._has_echoed = False                # since the port opened
        self._reply_handlers: Dict[_Kind, Callable[..., None]] = {
            _Kind.SYNC: self._sync_answered, _Kind.ECHO: self._echo_answered,
            _Kind.SILENCE: self._silence_interrupted, _Kind.CALL: self._call_answered}
        self._timeout_handlers: Dict[_Kind, Callable[..., None]] = {
            _Kind.SYNC: self._sync_timed_out, _Kind.ECHO: self._echo_timed_out,
            _Kind.SILENCE: self._silence_complete, _Kind.CALL: self._call_timed_out}

    # -- calls ------------------------------------------------------------------------

    def submit(self, call: Call) -> None:
        """Queue a call, from any thread; `Call.wait` returns its outcome."""
        self._submitted.append(call)

    @property
    def has_new_calls(self) -> bool:
        """Whether a call was submitted since the latest `step`."""
        return bool(self._submitted)

    # -- events -------------------------------------------------------------------------

    def connected(self, now: float) -> None:
        """The port is open: nothing is known about the board."""
        self.state = SessionState.UNSYNCHRONISED
        self._has_echoed = False
        self._unanswered_echoes = 0
        self._unanswered_syncs = 0
        self._last_received = now

    def disconnected(self, now: float, why: str) -> None:
        """The port is closed: every call returns."""
        self.state = SessionState.CLOSED
        exchange, self._exchange = self._exchange, None
        if isinstance(exchange, _CallExchange):
            exchange.call.finish(Outcome(
                TIMEOUT, f'the port closed before the reply arrived ({why}): {_UNKNOWN}'))
        self._queue_submitted(now)

    def received(self, frame: Frame, now: float) -> None:
        """A valid reply was received."""
        self._last_received = now
        exchange, reply = self._exchange, frame.message
        if reply.cmd1 == wire.ECHO:      # late or not, the board knows ECHO
            self._has_echoed = True
        if (self._retry is not None and self._retry.needs_confirmation
                and reply.cmd1 not in (wire.ERROR, wire.INVALID)
                and _may_answer(reply, self._retry.request)):
            self._doubt_invalid()
        elif exchange is None or (exchange.kind is _Kind.SILENCE and _lost_synchronism(reply)):
            self._exchange = None
            self._out_of_step(f'received a reply without a request: {reply}')
            if _lost_synchronism(reply):
                self._lose_synchronism(now)
        else:
            self._reply_handlers[exchange.kind](exchange, frame, now)

    def damaged(self, frame: Frame, now: float) -> None:
        """Bytes were received that are no valid reply."""
        self._last_received = now
        self._doubt_invalid()
        exchange = self._exchange
        if exchange is not None and exchange.kind is _Kind.SILENCE:
            self._expect_silence(now)
            return
        self._out_of_step('received bytes that are no valid reply')
        if isinstance(exchange, _CallExchange) and frame.cause == CHECKSUM:
            # Only a frame with a wrong checksum can be the reply. After noise, for example during
            # a motion, the reply may still arrive.
            self._repeat_or_finish(exchange, now, Outcome(
                TIMEOUT, f'the reply was damaged: {_UNKNOWN}'))

    def may_have_missed(self, why: str, now: float) -> None:
        """Replies may have been received and dropped."""
        self._last_received = now
        self._out_of_step(why)
        exchange = self._exchange
        if isinstance(exchange, _CallExchange):
            exchange.reply_may_be_lost = True
        elif exchange is not None and exchange.kind is _Kind.SILENCE:
            self._expect_silence(now)
        self._doubt_invalid()

    def stalled(self, now: float) -> None:
        """The bridge stalled: a request that moves something and still waits is too old now."""
        self.may_have_missed('the bridge stalled', now)
        self._queue_submitted(now)
        for call in self._waiting():
            if not call.repeatable:
                self._abandon(call, STALLED)

    def _doubt_invalid(self) -> None:
        """An OK was received, or perhaps: the INVALID before it may have been for noise."""
        if self._retry is not None and self._retry.needs_confirmation:
            call, self._retry = self._retry, None
            call.finish(_unknown_after_invalid(call.last_try))

    # -- what to do ---------------------------------------------------------------------

    def step(self, now: float, waits_for: str = '',
             port_ready: bool = True) -> Tuple[Optional[wire.Request], Optional[float]]:
        """Do what is due now.

        Args:
            waits_for: what has to be received before a request may be sent, for people; '':
                nothing. A call that interrupts does not wait for it.
            port_ready: False: nothing at all can be sent now.

        Returns:
            The request to send now, or None, and the time of the next call at the latest, or None.
            The request counts as outstanding from now on.
        """
        self._waits_for = waits_for
        self._queue_submitted(now)
        exchange = self._exchange
        if exchange is not None and now >= exchange.deadline:
            self._exchange = None
            self._timeout_handlers[exchange.kind](exchange, now)
        self._abandon_overdue(now)
        if port_ready and self._at_once:
            return self._send_at_once(), now
        may_send = port_ready and not waits_for
        request, silent_until = self._next_request(now) if may_send else (None, None)
        times = [self._expiry(call) for call in self._waiting()]
        if silent_until is not None:
            times.append(silent_until)
        if self._exchange is not None:
            times.append(self._exchange.deadline)
        return request, min(times, default=None)

    @property
    def synchronised(self) -> bool:
        """Whether the board has answered SYNC and is still synchronised."""
        return self.state not in (SessionState.CLOSED, SessionState.UNSYNCHRONISED)

    @property
    def in_step(self) -> bool:
        """Whether requests of calls may be sent."""
        return self.state in (SessionState.IN_STEP, SessionState.FENCED)

    @property
    def outstanding_request(self) -> Optional[wire.Request]:
        """The request whose reply is expected, or None."""
        return self._exchange.request if self._exchange else None

    def condition(self) -> Condition:
        """Whether the link can serve calls, and if not, why."""
        if not self.synchronised:
            return Condition.NO_SYNC if self._unanswered_syncs else Condition.SYNCHRONISING
        if not self.in_step:
            return Condition.NO_ECHO if self._unanswered_echoes else Condition.OUT_OF_STEP
        return Condition.READY

    def not_sent(self, why: str) -> None:
        """The request that `step` returned could not be sent."""
        exchange, self._exchange = self._exchange, None
        if exchange is None:
            self._repeat_interruption()
        elif isinstance(exchange, _CallExchange):
            last_try = exchange.call.last_try
            exchange.call.finish(Outcome(NOT_SENT, f'{why}; nothing was sent')
                                 if last_try is _NOT_TRIED else last_try)

    # -- fences -------------------------------------------------------------------------

    @property
    def _never_echoes(self) -> bool:
        """Whether the board seems not to know ECHO."""
        return not self._has_echoed and self._unanswered_echoes >= ECHO_TRIES

    def _needs_fence(self, call: Call) -> bool:
        """Whether a reply to the request before could be taken for the reply to this one."""
        return call.always_fenced or (call.poll and call.request != self._latest_request)

    def _is_fenced(self, call: Call, now: float) -> bool:
        """Whether no reply can be under way, and the board, for a move, has just been heard."""
        return self.state is SessionState.FENCED and (
            call.repeatable or now <= self._fenced_at + FENCE_AGE)

    def _out_of_step(self, why: str) -> None:
        if self.in_step:
            self._log.warn('out of step', f'out of step: {why}; sending ECHO to get in step again')
        if self.synchronised:
            self.state = SessionState.OUT_OF_STEP

    def _lose_synchronism(self, now: float) -> None:
        self.state = SessionState.UNSYNCHRONISED
        self._begun_anew(now)

    # -- sending ------------------------------------------------------------------------

    def _next_request(self, now: float) -> Tuple[Optional[wire.Request], Optional[float]]:
        """The request to send now, and the end of the silence that has to precede the next one."""
        if self._exchange is not None or self.state is SessionState.CLOSED:
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
            if call.tries and not self._may_have(call):
                call.invalid_unconfirmed = False    # in step: an ECHO has returned since
                self._abandon(call, _NOT_ANNOUNCED)
                continue
            if call.tries and self._needs_fence(call):
                if not self._never_echoes and not self._is_fenced(call, now):
                    return self._send_echo(now), None
                if self._never_echoes and now < self._last_received + FENCE_SILENCE:
                    return None, self._last_received + FENCE_SILENCE
            self._remove(call)
            if not call.tries:      # it only waited for the ECHO that confirms its last try
                call.finish(call.last_try)
            elif call.claim():
                return self._send_call(call, now), None

    def _may_have(self, call: Call) -> bool:
        """Whether the board is known to have the function; see rule 12."""
        return not call.announced or self._still_announces()

    def _send_echo(self, now: float) -> wire.Request:
        return self._send(_Kind.ECHO, wire.echo(self._nonce()), now)

    def _send(self, kind: _Kind, request: wire.Request, now: float) -> wire.Request:
        return self._begin(_Exchange(kind, request, now, now + self._reply_timeout))

    def _send_call(self, call: Call, now: float) -> wire.Request:
        call.invalid_unconfirmed = False
        fenced = self.state is SessionState.FENCED
        self.state = SessionState.IN_STEP
        return self._begin(_CallExchange(_Kind.CALL, call.request, now, now + call.timeout, call,
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
            self.state = SessionState.OUT_OF_STEP
            self._begun_anew(now)
            if self._unanswered_echoes >= ECHO_TRIES:
                self._expect_silence(now)
        elif reply.cmd1 != wire.INVALID:     # INVALID: the SYNC was damaged; it is sent again later
            self._out_of_step(f'{reply} to SYNC')

    def _echo_answered(self, exchange: _Exchange, frame: Frame, now: float) -> None:
        reply = frame.message
        if reply.cmd1 == wire.ECHO and reply.data == exchange.request.data:
            self._exchange = None
            self._unanswered_echoes = 0
            self.state = SessionState.FENCED
            self._fenced_at = now
        elif _lost_synchronism(reply):
            self._exchange = None
            self._echo_unanswered()
            self._lose_synchronism(now)
        else:
            self._out_of_step(f'{reply} to ECHO')

    def _silence_interrupted(self, _exchange: _Exchange, _frame: Frame, now: float) -> None:
        self._expect_silence(now)

    def _call_answered(self, exchange: _CallExchange, frame: Frame, now: float) -> None:
        reply, request, call = frame.message, exchange.request, exchange.call
        if not self._answers(reply, call):
            # The reply to another request, or an echo of other bytes. The right one may follow.
            exchange.other_reply = reply
            self._out_of_step(f'{reply} to {request}')
            return
        data_error = self._data_error(reply, call) if reply.cmd1 == wire.OK else ''
        if data_error:
            self._unexpected_data(exchange, frame, data_error, now)
            return
        round_trip = now - exchange.sent
        self.round_trips.append(round_trip)
        outcome = _outcome_of(reply, request, round_trip, frame.stamp)
        if reply.cmd1 == wire.ECHO:
            self._unanswered_echoes = 0
        elif reply.cmd1 == wire.SYNC:
            self._begun_anew(now)
        if reply.cmd1 != wire.INVALID:
            self._finish(exchange, now, outcome)
            return
        if exchange.reply_may_be_lost and call.always_fenced:     # so the INVALID may be for noise
            if _lost_synchronism(reply):
                self._lose_synchronism(now)
            self._finish(exchange, now, _unknown_after_invalid(outcome))
            return
        code = reply.error_code
        if code not in (wire.NOT_SYNCHRONISED, wire.CHECKSUM_MISMATCH):
            call.tries = 0
        if code == wire.NOT_SYNCHRONISED:
            self._lose_synchronism(now)
        elif call.always_fenced:
            self.state = SessionState.OUT_OF_STEP
        call.invalid_unconfirmed = call.always_fenced
        if call.tries or call.invalid_unconfirmed:
            self._send_again(exchange, now, outcome)
        else:
            self._finish(exchange, now, outcome)

    def _answers(self, reply: wire.Reply, call: Call) -> bool:
        """Whether this can be the reply to that call."""
        layout = call.reply_layout
        if (self._never_echoes and reply.cmd1 == wire.OK and reply.data
                and layout is not None and layout.is_empty):
            return False     # without a fence it may be the reply to another request
        return _may_answer(reply, call.request)

    def _data_error(self, reply: wire.Reply, call: Call) -> str:
        """Count an OK with invalid data; return what is wrong with it, or ''."""
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

    def _unexpected_data(self, exchange: _CallExchange, frame: Frame, data_error: str,
                         now: float) -> None:
        """An OK with data that the call does not expect was received."""
        data, call = frame.message.data, exchange.call
        text = (f'the OK to "{exchange.request}" is invalid: {data_error}; check that the board\'s '
                'firmware has the same layout')
        self._log.warn('unexpected', text)
        self.state = SessionState.OUT_OF_STEP
        exchange.other_reply = frame.message
        outcome = Outcome(wire.OK, text, 0, data, now - exchange.sent, False, frame.stamp)
        if exchange.fenced:
            self._finish(exchange, now, outcome)
        elif call.repeatable:
            self._repeat_or_finish(exchange, now, outcome)
        # Otherwise the board never echoes, and the right reply may follow.

    # -- timeouts -----------------------------------------------------------------------

    def _sync_timed_out(self, _exchange: _Exchange, now: float) -> None:
        self.timeouts += 1
        self._lose_synchronism(now)
        self._unanswered_syncs += 1
        self._repeat_interruption()

    def _echo_timed_out(self, _exchange: _Exchange, _now: float) -> None:
        self.timeouts += 1
        self.state = SessionState.OUT_OF_STEP
        self._echo_unanswered()
        self._repeat_interruption()

    def _echo_unanswered(self) -> None:
        self._unanswered_echoes += 1
        if self._unanswered_echoes == ECHO_TRIES:
            self._log.warn('no echo', 'the board does not answer ECHO; a SYNC and '
                           f'{self._reply_timeout:g} s of silence replace it')

    def _silence_complete(self, _exchange: _Exchange, now: float) -> None:
        self.state = SessionState.FENCED
        self._fenced_at = now
        if self._has_echoed:        # the board knows ECHO, so the line lost these: try ECHO again
            self._unanswered_echoes = 0

    def _call_timed_out(self, exchange: _CallExchange, now: float) -> None:
        self.timeouts += 1
        within = f'within {exchange.call.timeout:g} s'
        if exchange.other_reply is not None:
            within += f' but {exchange.other_reply}, perhaps the reply to another request'
        self._log.warn('timeout', f'no reply to "{exchange.request}" {within}')
        self._out_of_step('no reply')
        if not exchange.call.repeatable:
            self._drop_output(exchange.sent)      # before the caller is told
        self._repeat_or_finish(exchange, now, Outcome(TIMEOUT, f'no reply {within}: {_UNKNOWN}'))

    # -- the end of an exchange -----------------------------------------------------------

    def _repeat_or_finish(self, exchange: _CallExchange, now: float, outcome: Outcome) -> None:
        """End a try whose outcome is unknown."""
        if exchange.call.repeatable and exchange.call.tries:
            self._send_again(exchange, now, outcome)
        else:
            self._finish(exchange, now, outcome)

    def _send_again(self, exchange: _CallExchange, now: float, outcome: Outcome) -> None:
        """Queue the call again: before all other calls; a poll before all other polls."""
        self._exchange = None
        self._served_until = now
        call = exchange.call
        call.last_try = outcome
        call.expires = now + self._longest_wait
        if call.invalid_unconfirmed:    # its caller waits only for the ECHO that confirms it
            call.expires = min(now + max(call.timeout, NOT_READY_WAIT),
                               call.submitted + self._longest_wait + call.timeout)
        if call.poll:
            self._polls.appendleft(call)
        else:
            self._retry = call

    def _finish(self, exchange: _CallExchange, now: float, outcome: Outcome) -> None:
        self._exchange = None
        self._served_until = now
        call = exchange.call
        call.finish(outcome)
        if outcome.success and call.on_success:
            call.on_success(outcome)

    # -- interruptions; see rule 8 ----------------------------------------------------------

    def _interrupt(self, call: Call, now: float) -> None:
        """Prepare to send this call at once."""
        exchange = self._exchange
        if self.synchronised:
            self.state = SessionState.OUT_OF_STEP
        if isinstance(exchange, _CallExchange):
            self._repeat_or_finish(exchange, now, Outcome(
                TIMEOUT, f'{call.request} was sent before the reply: {_UNKNOWN}'))
        self._exchange = None
        self._at_once.append(call)
        for other in self._waiting():
            if not other.interrupts:
                self._abandon(other, f'{call.request} was called')

    def _send_at_once(self) -> Optional[wire.Request]:
        call = self._at_once.pop(0)
        if not self._may_have(call):
            self._abandon(call, _NOT_ANNOUNCED)
            return None
        call.last_try = Outcome(TIMEOUT, f'no reply is known to be the one to this: {_UNKNOWN}')
        return call.request if call.claim(tries=0) else None

    def _repeat_interruption(self) -> None:
        """Send calls that interrupt at once again: the line may have lost them."""
        self._at_once = [call for call in self._waiting() if call.interrupts]

    # -- calls that wait ------------------------------------------------------------------

    def _next_call(self) -> Optional[Call]:
        """The call to send next, or None."""
        if self._retry is not None:
            return self._retry
        waiting = self._calls or self._polls
        return waiting[0] if waiting else None

    def _waiting(self) -> List[Call]:
        waiting = list(self._calls) + list(self._polls)
        if self._retry is not None:
            waiting.append(self._retry)
        return waiting

    def _queue_submitted(self, now: float) -> None:
        while self._submitted:
            call = self._submitted.popleft()
            call.expires = call.submitted + self._longest_wait
            if call.interrupts and self.state is not SessionState.CLOSED:
                self._interrupt(call, now)
            (self._polls if call.poll else self._calls).append(call)
        if self.state is SessionState.CLOSED:
            for call in self._waiting():
                self._abandon(call, 'the port is closed')

    def _remove(self, call: Call) -> None:
        if call in self._at_once:
            self._at_once.remove(call)
        if call is self._retry:
            self._retry = None
            return
        for queue in (self._calls, self._polls):
            try:
                queue.remove(call)
            except ValueError:
                pass

    def _expiry(self, call: Call) -> float:
        """When a waiting call is given up.

        That is sooner while the link is not ready. But a synchronised board may first have to
        finish something, such as a move, before it answers ECHO.
        """
        exchange = self._exchange
        if self.in_step or call.interrupts or isinstance(exchange, _CallExchange):
            return call.expires
        wait = max(NOT_READY_WAIT, call.timeout) if self.synchronised else NOT_READY_WAIT
        return min(call.expires, max(call.submitted, self._served_until) + wait)

    def _abandon_overdue(self, now: float) -> None:
        for call in self._waiting():
            if call.outcome is not None:      # its caller has given up
                self._remove(call)
            elif now >= self._expiry(call):
                self._abandon(call, self._why_it_waits())

    def _why_it_waits(self) -> str:
        if self._waits_for and not isinstance(self._exchange, _CallExchange):
            return f'the link waits for {self._waits_for}'
        return self.condition().value or 'the bus is busy with other calls'

    def _abandon(self, call: Call, why: str) -> None:
        """Give up a waiting call: it is not sent, or not sent again."""
        self._remove(call)
        if call.invalid_unconfirmed:
            call.finish(_unknown_after_invalid(call.last_try))
        elif call.last_try is not _NOT_TRIED:
            call.finish(call.last_try)
        elif call.request == wire.SYNC_REQUEST:
            call.finish(Outcome(NOT_SENT, why))     # but the Master itself may have sent SYNC
        else:
            call.finish(Outcome(NOT_SENT, f'{why}; nothing was sent'))


def _lost_synchronism(reply: wire.Reply) -> bool:
    return reply.cmd1 == wire.INVALID and reply.error_code == wire.NOT_SYNCHRONISED


def _may_answer(reply: wire.Reply, request: wire.Request) -> bool:
    """Whether a reply of this type can be the reply to that request."""
    if reply.cmd1 in (wire.ERROR, wire.INVALID):
        return True
    if request.cmd1 == wire.ECHO:
        return reply.cmd1 == wire.ECHO and reply.data == request.data
    if request.cmd1 == wire.SYNC:
        return reply.cmd1 == wire.SYNC
    return reply.cmd1 == wire.OK


def _unknown_after_invalid(invalid: Outcome) -> Outcome:
    """The outcome after an INVALID that may have been for noise before the request."""
    return Outcome(TIMEOUT, f'received INVALID ({wire.describe_error(invalid.error_code)}), '
                   f'perhaps because of noise on the line: {_UNKNOWN}', invalid.error_code)


def _outcome_of(reply: wire.Reply, request: wire.Request, round_trip: float,
                stamp: Any) -> Outcome:
    """The outcome of a request with this reply."""
    code = reply.error_code
    if reply.cmd1 == wire.INVALID:
        message = f'refused, nothing was executed: {wire.describe_error(code)}'
    elif reply.cmd1 == wire.ERROR:
        message = f'the board refused: {wire.describe_error(code)}'
    else:
        message = f'done: {request}'
    return Outcome(reply.cmd1, message, code, reply.data, round_trip, True, stamp)
