"""The Master on a robot-ctrl-bus: which request may be sent when, and what a reply means.

A state machine without I/O and without a clock. The link, which owns the port, reports what it
received and at what time, and calls `step`, which returns the request to send and the time of the
next call. session.py has its states and transitions, call.py the calls that it serves.
"""
import os
from collections import Counter, deque
from dataclasses import dataclass
from typing import Callable, Deque, Dict, Optional, Tuple

from ...framing.stream import CHECKSUM, Frame
from ...link.outcome import STOPPED, TIMEOUT, Outcome
from ...link.sparing_log import SparingLog
from . import wire
from .call import NOT_READY_WAIT, UNKNOWN, Call, CallQueue, outcome_of, unknown_after_invalid
from .session import (NOTHING, Condition, Event, Exchange, Kind, Session, SessionState, event_of,
                      may_answer)

FENCE_SILENCE = 0.02   # s of silence as a fence: a USB adapter delivers bytes up to 16 ms late
FENCE_AGE = 1.0        # s; before a move, an older fence is renewed

STALLED = 'it may have waited while the bridge stalled'
_NOT_ANNOUNCED = 'the board may have begun anew, and has not announced this function since'
_NEVER = float('inf')


@dataclass
class CallExchange(Exchange):
    """The outstanding request of a call."""

    call: Call
    fenced: bool                               # no reply to an earlier request can arrive
    other_reply: Optional[wire.Reply] = None   # the latest reply that cannot be for this request
    reply_may_be_lost: bool = False            # the reply may have been received and dropped


class Master(Session):
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
        is_stopped: whether ~stop refuses what is not repeatable.
        echoes: whether the board knows ECHO; if not, a silence is the fence: see rule 6.
    """

    def __init__(self, reply_timeout: float, motion_timeout: float, log: SparingLog,
                 nonce: Callable[[], bytes] = lambda: os.urandom(4),
                 drop_output: Callable[[float], None] = lambda sent: None,
                 begun_anew: Callable[[float], None] = lambda now: None,
                 still_announces: Callable[[], bool] = lambda: True, echoes: bool = True,
                 is_stopped: Callable[[], bool] = lambda: False) -> None:
        super().__init__(reply_timeout, log, nonce, begun_anew, echoes)
        self.calls = CallQueue(max(motion_timeout, NOT_READY_WAIT))
        self._submitted: Deque[Call] = deque()     # from other threads
        self.timeouts = 0
        self.data_errors: Dict[str, int] = Counter()         # in an OK, by cause
        self.round_trips: Deque[float] = deque(maxlen=200)     # s; the latest
        self._drop_output = drop_output
        self._still_announces = still_announces
        self._is_stopped = is_stopped
        self._closed = 'the port is closed'     # and why, in words
        self._stalled_at = -_NEVER      # when the latest stall had ended
        self._interrupted: Optional[CallExchange] = None    # of a move that a stop has ended

    @property
    def outstanding_call(self) -> Optional[Call]:
        """The call whose reply is expected, or None."""
        exchange = self._exchange
        return exchange.call if isinstance(exchange, CallExchange) else None

    # -- events -------------------------------------------------------------------------

    def under_way(self) -> str:
        """What the board executes and must not be interrupted, for people; '': nothing."""
        call = self.outstanding_call
        return '' if call is None or call.function.repeatable else f'"{call.request}" is under way'

    def submit(self, call: Call) -> Call:
        """Queue a call, from any thread, and return it; `Call.wait` returns its outcome."""
        self._submitted.append(call)
        return call

    def disconnected(self, now: float, why: str) -> None:
        """The port is closed: every call returns."""
        self.state = SessionState.CLOSED
        self._closed = f'the port is closed ({why})'
        exchange, self._exchange = self._exchange, NOTHING
        self._interrupted = None
        if isinstance(exchange, CallExchange):
            exchange.call.finish(Outcome(
                TIMEOUT, f'the port closed before the reply arrived ({why}): {UNKNOWN}'))
        self._take_calls(now)

    def received(self, frame: Frame, now: float) -> None:
        """A valid reply was received."""
        reply, exchange = frame.message, self._exchange
        self._last_bytes = now
        self.calls.doubt_invalid(reply)
        if isinstance(exchange, CallExchange):
            self._call_answered(exchange, frame, now)
        else:
            self._own_answered(reply, now)

    def damaged(self, frame: Frame, now: float) -> None:
        """Bytes were received that are not a valid reply."""
        exchange = self._exchange
        self._last_bytes = now
        self.calls.doubt_invalid()
        # Only a frame with a wrong checksum can be the reply. After noise, for example during a
        # motion, the reply may still arrive.
        is_reply = frame.cause == CHECKSUM
        self._happened(Event.DAMAGED if is_reply else Event.NOISE, now,
                       'received bytes that are no valid reply')
        if isinstance(exchange, CallExchange):
            if is_reply:
                self.calls.try_failed(exchange.call, Outcome(
                    TIMEOUT, f'the reply was damaged: {UNKNOWN}'), now)
            exchange.reply_may_be_lost = True      # noise may have been the reply

    def may_have_missed(self, why: str, now: float) -> None:
        """Replies may have been received and dropped."""
        self._happened(Event.MISSED, now, why)
        if isinstance(self._exchange, CallExchange):
            self._exchange.reply_may_be_lost = True
        self.calls.doubt_invalid()

    def stalled(self, now: float) -> None:
        """The bridge stalled: a request that moves something and still waits is too old now."""
        self.may_have_missed('the bridge stalled', now)
        self._stalled_at = now
        self._take_calls(now)
        for call in self.calls:
            if not call.function.repeatable:
                self.calls.abandon(call, STALLED)

    def sent(self, request: wire.Request) -> None:
        """The request that `step` returned was written."""
        for call in self.calls:
            if call.request is request:     # one that interrupts stays in the queue
                call.written.set()

    def not_sent(self, why: str) -> None:
        """The request that `step` returned could not be sent."""
        exchange, self._exchange = self._exchange, NOTHING
        if isinstance(exchange, CallExchange):
            exchange.call.give_up(why)
        else:
            self.calls.stop_again()     # what waited in the port is dropped, perhaps a stop, too

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
        self._take_calls(now)
        if now >= self._exchange.deadline:
            self._timed_out(self._exchange, now)
        if port_ready:      # also a stop that is overdue, since it waited during a stall
            for call in self.calls:
                why = self._why_not(call)
                if call.at_once and why:
                    self.calls.abandon(call, why)
                elif call.at_once:
                    return call.request if call.claim_at_once() else None, now
        self._abandon_overdue(now, waits_for)
        request, due = self._next_request(now) if port_ready and not waits_for else (None, _NEVER)
        due = min([due, self._exchange.deadline, *map(self._expiry, self.calls)])
        return request, due if due < _NEVER else None

    def _next_request(self, now: float) -> Tuple[Optional[wire.Request], float]:
        """The request to send now, or None, and when to look for one again."""
        if self._exchange is not NOTHING or self.state is SessionState.CLOSED:
            return None, _NEVER
        if not self.in_step:
            return self._probe(now), _NEVER
        call = self._next_call()
        if call is None:
            return None, _NEVER
        is_fenced = self.state is SessionState.FENCED
        silent_until = self._last_bytes + self._silence
        if now >= silent_until:
            self._silence = FENCE_SILENCE
        if self._needs_fence(call):
            is_old = now > self._fenced_at + FENCE_AGE     # rule 10
            if self._echoes and (not is_fenced or is_old and not call.function.repeatable):
                return self._probe(now), _NEVER
            if not self._echoes and now < silent_until:
                return None, silent_until
        self.calls.remove(call)
        if not call.claim():
            return None, now
        call.tries -= 1
        self.state = SessionState.IN_STEP
        return self._begin(CallExchange(Kind.CALL, call.request, now, now + call.timeout, call,
                                        is_fenced)), _NEVER

    def _next_call(self) -> Optional[Call]:
        """The first call that may be sent; those before it end."""
        for call in iter(self.calls.next, None):
            if call.invalid and not call.tries:
                call.finish(call.invalid)       # in step: an ECHO has returned since; rule 4
            why = self._why_not(call)
            if call.outcome is None and not why:
                return call
            self.calls.abandon(call, why)
        return None

    def _needs_fence(self, call: Call) -> bool:
        """Whether a reply to the request before could be taken for its reply; rule 6."""
        if call.poll:
            return call.request != self._latest_request
        return not call.function.repeatable or call.request.cmd1 not in (wire.SYNC, wire.ECHO)

    def _why_not(self, call: Call) -> str:
        """Why a call may not be sent; '' if it may."""
        if self._is_stopped() and not call.function.repeatable:
            return STOPPED
        # Rule 12: the board has to be known to have the function.
        return _NOT_ANNOUNCED if call.function.announced and not self._still_announces() else ''

    # -- replies ------------------------------------------------------------------------

    def _call_answered(self, exchange: CallExchange, frame: Frame, now: float) -> None:
        """A reply was received while the request of a call is outstanding."""
        call, reply = exchange.call, frame.message
        # Rule 5
        is_foreign = not self._echoes and reply.cmd1 == wire.OK and reply.data \
            and call.function.reply.is_empty
        if is_foreign or not may_answer(reply, call.request):     # the right one may follow
            exchange.other_reply = reply
            exchange.reply_may_be_lost |= reply.cmd1 == wire.OK
            self._happened(Event.OTHER, now, f'{reply} to {call.request}')
            return
        cause, error = call.function.data_error(reply)
        if error:
            self.data_errors[cause] += 1
            self._data_wrong(exchange, frame, error, now)
            return
        outcome = outcome_of(reply, call.request, now - exchange.sent, frame.stamp)
        self.round_trips.append(outcome.round_trip)
        if reply.cmd1 == wire.SYNC:
            self._begun_anew(now)
        self._happened(event_of(reply, True), now)
        if reply.cmd1 != wire.INVALID:
            self.calls.finish(call, outcome, now)
        elif exchange.reply_may_be_lost or not self._echoes:
            self.calls.try_failed(call, unknown_after_invalid(outcome), now)
        else:
            self.calls.refused(call, outcome, now)

    def _data_wrong(self, exchange: CallExchange, frame: Frame, error: str, now: float) -> None:
        """An OK with data that the call does not expect was received; rule 5."""
        call = exchange.call
        text = (f'the OK to "{call.request}" is invalid: {error}; check that the board\'s firmware '
                'has the same layout')
        self._log.warn('unexpected', text)
        exchange.other_reply = frame.message
        outcome = Outcome(wire.OK, text, 0, frame.message.data, now - exchange.sent, False,
                          frame.stamp)
        if not self._echoes and not call.function.repeatable:
            exchange.reply_may_be_lost = True
            self._happened(Event.OTHER, now)
            return
        self._happened(Event.WRONG_DATA, now)
        if exchange.fenced:
            self.calls.finish(call, outcome, now)
        else:
            self.calls.try_failed(call, outcome, now)

    def _timed_out(self, exchange: Exchange, now: float) -> None:
        self.timeouts += 1
        if not isinstance(exchange, CallExchange):
            self._happened(Event.TIMEOUT, now)
            if self._interrupted and now >= self._interrupted.deadline:
                self._drop_output(self._interrupted.sent)       # rule 10
                self._interrupted = None
            self.calls.stop_again()
            return
        call, within = exchange.call, f'within {exchange.call.timeout:g} s'
        if exchange.other_reply is not None:
            within += f' but {exchange.other_reply}, perhaps the reply to another request'
        self._log.warn('timeout', f'no reply to "{call.request}" {within}')
        self._happened(Event.TIMEOUT, now, 'no reply')
        if not call.function.repeatable:
            self._drop_output(exchange.sent)      # before the caller is told; rule 10
        self.calls.try_failed(call, Outcome(TIMEOUT, f'no reply {within}: {UNKNOWN}'), now)

    # -- calls that interrupt; rule 8 -------------------------------------------------------

    def _take_calls(self, now: float) -> None:
        while self._submitted:
            call = self._submitted.popleft()
            if call.function.interrupts and self.state is not SessionState.CLOSED:
                why = self._why_not(call)
                if why:
                    call.give_up(why)       # what is not sent interrupts nothing
                    continue
                self._interrupt(call, now)
            self.calls.add(call)
            if call.submitted <= self._stalled_at and not call.function.repeatable:
                self.calls.abandon(call, STALLED)       # its thread went on later; rule 9
        if self.state is SessionState.CLOSED:
            for call in self.calls:
                self.calls.abandon(call, self._closed)

    def _interrupt(self, call: Call, now: float) -> None:
        """Prepare to send this call at once."""
        exchange = self._exchange
        self._happened(Event.STOP, now)
        if isinstance(exchange, CallExchange):
            if not exchange.call.function.repeatable:
                self._interrupted = exchange
            self.calls.try_failed(exchange.call, Outcome(
                TIMEOUT, f'{call.request} was sent before the reply: {UNKNOWN}'), now)
        call.at_once = True
        for other in self.calls:
            if not other.function.interrupts:
                self.calls.abandon(other, f'{call.request} was called')

    # -- calls that wait ------------------------------------------------------------------

    def _expiry(self, call: Call) -> float:
        """When a waiting call is given up.

        That is sooner while the link is not ready. But the board may first have to finish
        something, such as a move, before it answers ECHO.
        """
        if self.in_step or call.function.interrupts or self.outstanding_call:
            return call.expires
        is_late = self.condition() is Condition.OUT_OF_STEP
        wait = max(NOT_READY_WAIT, call.timeout) if is_late else NOT_READY_WAIT
        return min(call.expires, max(call.submitted, self.calls.served_until) + wait)

    def _abandon_overdue(self, now: float, waits_for: str) -> None:
        for call in self.calls:
            if call.outcome is not None:      # its caller has given up
                self.calls.remove(call)
            elif now < self._expiry(call):
                continue
            elif waits_for and not self.outstanding_call:
                self.calls.abandon(call, f'the link waits for {waits_for}')
            else:
                self.calls.abandon(call,
                                   self.condition().value or 'the bus is busy with other calls')
