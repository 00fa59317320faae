"""Calls of the bus: a request, who waits for its outcome, and the queue in which it waits."""
import enum
import threading
from typing import Any, Callable, Iterator, List, Optional

from ...link.outcome import LOOK, NOT_SENT, TIMEOUT, Outcome
from . import wire
from .session import Kind, may_answer

NOT_READY_WAIT = 0.8   # s that a call waits while the link is not ready

UNKNOWN = f'it is not known whether this was executed; {LOOK}'


class CallState(enum.Enum):
    """Where a call is."""

    WAITING = 'it waits for its turn, for the first time or again'
    SENT = 'its request is outstanding'
    CONFIRMING = 'it got an INVALID; when an ECHO has returned, it is refused or sent again'
    DONE = 'it has an outcome'


class Call:
    """One request and its outcome, shared by the caller, who waits, and the link, which sends it.

    Args:
        timeout: s from sending to the reply.
        tries: how often it may be sent in all.
        now: the time of the call.
        on_success: called in the link's thread with a successful outcome.
    """

    def __init__(self, request: wire.Request, function: wire.Function, timeout: float, tries: int,
                 now: float, poll: bool = False,
                 on_success: Optional[Callable[[Outcome], None]] = None) -> None:
        self.request = request
        self.function = function
        self.timeout = timeout
        self.tries = tries             # that are left
        self.submitted = now
        self.poll = poll               # it is sent only when no other call waits
        self.on_success = on_success
        self.state = CallState.WAITING
        self.at_once = False           # it is to be sent now, whatever is outstanding: see rule 8
        self.last_try: Optional[Outcome] = None     # outcome of the try before this one
        self.may_be_done = False       # an earlier try may have been executed: it is not refused
        self.expires = float('inf')    # when it is given up if it still waits
        self.outcome: Optional[Outcome] = None
        self._lock = threading.Lock()
        self.written = threading.Event()     # it was sent, or is over
        self._done = threading.Event()

    @property
    def kind(self) -> Kind:
        """What is outstanding once it is sent."""
        is_probe = self.function.repeatable and self.request.cmd1 in (wire.SYNC, wire.ECHO)
        return Kind.PROBE if self.poll or is_probe else Kind.CALL

    def claim(self) -> bool:
        """Count a try; False if the caller has given up, so it must not be sent."""
        with self._lock:
            if self.outcome is None:
                self.state = CallState.SENT
                self.tries -= 1
            return self.outcome is None

    def claim_at_once(self) -> bool:
        """The same, but it stays in the queue, and the try does not count."""
        with self._lock:
            self.at_once, self.may_be_done = False, True
            if self.outcome is None:
                self.last_try = Outcome(TIMEOUT, f'no reply is known to be the one to this: '
                                        f'{UNKNOWN}')
            return self.outcome is None

    def try_ended(self, state: CallState, outcome: Outcome) -> None:
        """Let it wait again, or for the ECHO that confirms an INVALID, after a try that had this
        outcome."""
        with self._lock:
            if self.outcome is None:
                self.state, self.last_try = state, outcome
                self.may_be_done |= outcome.status != wire.INVALID

    def confirm(self) -> None:
        """The ECHO has returned: it is refused, or waits to be sent again."""
        assert self.last_try is not None
        if self.tries:
            self.try_ended(CallState.WAITING, self.last_try)
        else:
            self.finish(self.last_try)

    def doubt(self) -> None:
        """The INVALID may have been for noise: it is neither refused nor confirmed."""
        assert self.last_try is not None
        self.try_ended(CallState.WAITING, unknown_after_invalid(self.last_try))

    def finish(self, outcome: Outcome) -> None:
        """Set the outcome and wake the caller; only the first outcome counts."""
        with self._lock:
            if self.outcome is None:
                if outcome.status == wire.INVALID and self.may_be_done:
                    outcome = unknown_after_invalid(outcome)
                self.state, self.outcome = CallState.DONE, outcome
        self.written.set()
        self._done.set()

    def give_up(self, why: str) -> None:
        """Finish it without sending it, or without sending it again; rule 7."""
        if self.state is CallState.CONFIRMING:
            self.doubt()
        if self.last_try is not None:
            self.finish(self.last_try)
        elif self.request == wire.SYNC_REQUEST and self.state is CallState.WAITING:
            self.finish(Outcome(NOT_SENT, why))     # but the Master itself may have sent SYNC
        else:
            self.finish(Outcome(NOT_SENT, f'{why}; nothing was sent'))

    def wait(self, seconds: float) -> Outcome:
        """Wait for the outcome, at most `seconds`; after that the request is never sent."""
        self._done.wait(seconds)
        with self._lock:        # so that it is not claimed, and then sent, meanwhile
            if self.outcome is None:
                was_sent = self.state is not CallState.WAITING or self.last_try is not None
                self.state = CallState.DONE
                self.outcome = Outcome(TIMEOUT, f'the bridge is stuck: {UNKNOWN}') if was_sent \
                    else Outcome(NOT_SENT, 'the bridge is stuck; nothing was sent')
            return self.outcome


class CallQueue:
    """The calls that wait for their turn, or for the ECHO that confirms an INVALID.

    Args:
        longest_wait: s that a call may wait for its turn.
    """

    def __init__(self, longest_wait: float) -> None:
        self.served_until = 0.0        # when the latest try of a call ended
        self._longest_wait = longest_wait
        self._waiting: List[Call] = []

    def add(self, call: Call) -> None:
        """Let a new call wait for its turn."""
        call.expires = call.submitted + self._longest_wait
        self._waiting.append(call)

    def again(self, call: Call, state: CallState, outcome: Outcome, now: float) -> None:
        """Let a call wait after a try with this outcome: a call before all others, a poll before
        all other polls."""
        call.try_ended(state, outcome)
        self.served_until = now
        call.expires = now + self._longest_wait
        if call.state is CallState.CONFIRMING:   # its caller waits only for the ECHO that confirms
            call.expires = min(now + max(call.timeout, NOT_READY_WAIT),
                               call.submitted + self._longest_wait + call.timeout)
        self._waiting.insert(0, call)

    def remove(self, call: Call) -> None:
        self._waiting.remove(call)

    def abandon(self, call: Call, why: str) -> None:
        """Give up a waiting call: it is not sent, or not sent again."""
        self._waiting.remove(call)
        call.give_up(why)

    def try_failed(self, call: Call, outcome: Outcome, now: float) -> None:
        """End a try whose outcome is unknown; rule 4."""
        if call.function.repeatable and call.tries:
            self.again(call, CallState.WAITING, outcome, now)
        else:
            self.finish(call, outcome, now)

    def refused(self, call: Call, invalid: Outcome, now: float) -> None:
        """An INVALID ended a try; rule 4."""
        if invalid.error_code not in (wire.NOT_SYNCHRONISED, wire.CHECKSUM_MISMATCH):
            call.tries = 0
        if call.kind is Kind.CALL:
            self.again(call, CallState.CONFIRMING, invalid, now)
        elif call.tries:
            self.again(call, CallState.WAITING, invalid, now)
        else:
            self.finish(call, invalid, now)

    def finish(self, call: Call, outcome: Outcome, now: float) -> None:
        """End a call that was sent."""
        self.served_until = now
        call.finish(outcome)
        if outcome.success and call.on_success:
            call.on_success(outcome)

    def __iter__(self) -> Iterator[Call]:
        """The calls that wait; they may be removed meanwhile."""
        return iter(list(self._waiting))

    def next(self) -> Optional[Call]:
        """The call to send next, or None: calls go before polls; rule 1."""
        return min(self._waiting, key=lambda call: call.poll) if self._waiting else None

    def stop_again(self) -> None:
        """Send calls that interrupt at once again: the line may have lost them; rule 8."""
        for call in self._waiting:
            call.at_once = call.function.interrupts

    def doubt_invalid(self, reply: Optional[wire.Reply] = None) -> None:
        """A reply, or what may have been one, was received: the INVALID before it may have been for
        noise, so a call that waited for the ECHO that confirms it is not refused; rule 4."""
        for call in self:
            if call.state is CallState.CONFIRMING and (
                    reply is None or reply.cmd1 not in (wire.ERROR, wire.INVALID)
                    and may_answer(reply, call.request)):
                call.doubt()
                if not (call.function.repeatable and call.tries):
                    self.abandon(call, '')


def unknown_after_invalid(invalid: Outcome) -> Outcome:
    """The outcome after an INVALID that may have been for noise before the request; rule 4."""
    return Outcome(TIMEOUT, f'received INVALID ({wire.describe_error(invalid.error_code)}), '
                   f'perhaps because of noise on the line: {UNKNOWN}', invalid.error_code)


def outcome_of(reply: wire.Reply, request: wire.Request, round_trip: float,
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
