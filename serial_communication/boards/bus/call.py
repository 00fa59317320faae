"""Calls of the bus: a request, who waits for its outcome, and the queue in which it waits."""
import threading
from typing import Any, Callable, Iterator, List, Optional

from ...link.outcome import LOOK, NOT_SENT, TIMEOUT, Outcome
from . import wire
from .session import may_answer

NOT_READY_WAIT = 0.8   # s that a call waits while the link is not ready

UNKNOWN = f'it is not known whether this was executed; {LOOK}'


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
        self.at_once = False           # it is to be sent now, whatever is outstanding: see rule 8
        self.may_be_done = False       # a try may have been executed: it is not told as refused
        self.last_try: Optional[Outcome] = None    # what it is told if it is not sent again
        self.invalid: Optional[Outcome] = None     # the same once an ECHO has returned; rule 4
        self.expires = float('inf')    # when it is given up if it still waits
        self.outcome: Optional[Outcome] = None
        self._claimed = False          # a try has begun
        self._lock = threading.Lock()
        self.written = threading.Event()     # it was sent, or is over
        self._done = threading.Event()

    def claim(self) -> bool:
        """Begin a try; False if the caller has given up, so it must not be sent."""
        with self._lock:
            self._claimed = self.outcome is None
            return self._claimed

    def claim_at_once(self) -> bool:
        """The same for a stop, but it stays in the queue, and the try does not count; rule 8."""
        self.at_once, self.may_be_done = False, True
        self.last_try = Outcome(TIMEOUT, f'no reply is known to be the one to this: {UNKNOWN}')
        return self.claim()

    def finish(self, outcome: Outcome) -> None:
        """Set the outcome and wake the caller; only the first outcome counts."""
        if outcome.status == wire.INVALID and self.may_be_done:
            outcome = unknown_after_invalid(outcome)
        with self._lock:
            if self.outcome is None:
                self.outcome = outcome
        self.written.set()
        self._done.set()

    def give_up(self, why: str) -> None:
        """Finish it without sending it, or without sending it again; rule 7."""
        if self.last_try is not None:
            self.finish(self.last_try)
        elif self.request == wire.SYNC_REQUEST:
            self.finish(Outcome(NOT_SENT, why))     # the Master itself may have sent SYNC
        else:
            self.finish(Outcome(NOT_SENT, f'{why}; nothing was sent'))

    def wait(self, seconds: float) -> Outcome:
        """Wait for the outcome, at most `seconds`; after that the request is never sent."""
        self._done.wait(seconds)
        with self._lock:        # so that it is not claimed, and then sent, meanwhile
            if self.outcome is None:
                self.outcome = Outcome(TIMEOUT, f'the bridge is stuck: {UNKNOWN}') \
                    if self._claimed else Outcome(NOT_SENT, 'the bridge is stuck; nothing was sent')
            return self.outcome


class CallQueue:
    """The calls that wait for their turn, for the first time or again.

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

    def _again(self, call: Call, outcome: Outcome, now: float) -> None:
        """Let a call wait after a try with this outcome: a call before all others, a poll before
        all other polls."""
        call.last_try = outcome
        self.served_until = now
        call.expires = now + self._longest_wait
        self._waiting.insert(0, call)

    def remove(self, call: Call) -> None:
        self._waiting.remove(call)

    def abandon(self, call: Call, why: str) -> None:
        """Give up a waiting call: it is not sent, or not sent again."""
        self._waiting.remove(call)
        call.give_up(why)

    def try_failed(self, call: Call, outcome: Outcome, now: float) -> None:
        """End a try whose outcome is unknown; rule 4."""
        call.may_be_done, call.invalid = True, None
        if call.function.repeatable and call.tries:
            self._again(call, outcome, now)
        else:
            self.finish(call, outcome, now)

    def refused(self, call: Call, invalid: Outcome, now: float) -> None:
        """An INVALID ended a try: the next ECHO that returns confirms it; rule 4."""
        if invalid.error_code not in (wire.NOT_SYNCHRONISED, wire.CHECKSUM_MISMATCH):
            call.tries = 0
        call.invalid = invalid
        self._again(call, unknown_after_invalid(invalid), now)

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
        noise, so its call is not refused; rule 4."""
        for call in self:
            if call.invalid and (reply is None or reply.cmd1 not in (wire.ERROR, wire.INVALID)
                                 and may_answer(reply, call.request)):
                call.invalid, call.may_be_done = None, True
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
