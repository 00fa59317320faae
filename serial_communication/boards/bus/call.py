"""Calls of the bus: a request and its outcome, and the queue in which calls wait for their turn."""
import threading
from dataclasses import dataclass, field
from typing import Any, Callable, List, NamedTuple, Optional, Tuple

from ...link.outcome import LOOK, NOT_SENT, TIMEOUT, Outcome
from . import wire

OnSuccess = Callable[[Outcome], None]
UNKNOWN = f'it is not known whether this was executed; {LOOK}'


@dataclass(eq=False)
class Call:
    """One request and its outcome. The Master changes it; other threads wait until it is over."""

    request: wire.Request
    function: wire.Function
    timeout: float      # s from sending to the reply
    tries: int          # how often it may still be sent
    asked: float        # when it was called
    is_poll: bool = False
    on_success: Optional[OnSuccess] = None      # called in the link's thread
    waits_since: float = float('inf')   # for its turn
    is_urgent: bool = False             # a stop that is to be sent now; rule 8
    told: Optional[Outcome] = None      # unless it is sent again; None: nothing was sent
    refused: Optional[Outcome] = None   # instead, once an ECHO has returned: no try was executed
    outcome: Optional[Outcome] = None
    over: threading.Event = field(default_factory=threading.Event)

    def without_reply(self, why: str) -> Outcome:
        """The outcome if it is not sent, or not sent again; rule 7."""
        return self.told or Outcome(NOT_SENT, f'{why}; nothing was sent')

    def data_error(self, reply: wire.Reply, echoes: bool) -> Tuple[str, str]:
        """Why the data of an OK are invalid, '' if they are not: the cause that is counted, and in
        words; rule 5."""
        if not echoes and reply.data and self.function.reply.is_empty:
            return '', 'it has data, so it is the reply to another request'
        cause, error = self.function.data_error(reply)
        return cause, error and (f'the OK to "{self.request}" is invalid: {error}; check that the '
                                 'board\'s firmware has the same layout')

    def finish(self, outcome: Outcome) -> None:
        """Set the outcome; only the first one counts."""
        if self.outcome is None:
            self.outcome = outcome
            if outcome.success and self.on_success:
                self.on_success(outcome)
        self.over.set()


class MasterOptions(NamedTuple):
    """Parameters of the session; times are in s."""

    reply_timeout: float = 0.5
    motion_timeout: float = 5.0
    retries: int = 2                   # further tries of a repeatable request
    environment_datelen: int = 2
    reply_has_cmd2: bool = False
    echo: bool = True                  # whether the board knows ECHO
    announcements: bool = False        # ask the board for its announcement after each connect

    def call(self, request: wire.Request, function: wire.Function, now: float,
             on_success: Optional[OnSuccess] = None, is_poll: bool = False) -> Call:
        """A call, to be submitted."""
        moves = wire.BUILT_IN.get(request[:2], function).moves      # a raw request may be one, too
        timeout = self.motion_timeout if moves else self.reply_timeout
        return Call(request, function, function.timeout or timeout, 1 + self.retries, now, is_poll,
                    on_success)


class Queue:
    """The calls that wait for their turn, for the first time or again.

    Args:
        longest_wait: s for which a call waits for each of its turns.
    """

    def __init__(self, longest_wait: float) -> None:
        self.longest_wait = longest_wait
        self.waiting: List[Call] = []

    def urgent(self) -> List[Call]:
        """The stops to send now, whatever is outstanding; rule 8."""
        return [call for call in self.waiting if call.is_urgent]

    def next(self) -> Optional[Call]:
        """The call to send next: calls go before polls; rule 1."""
        return min(self.waiting, key=lambda call: call.is_poll) if self.waiting else None

    def due(self) -> float:
        """When the next one has waited for too long."""
        return min((call.waits_since + self.longest_wait for call in self.waiting),
                   default=float('inf'))

    def again(self, call: Call, now: float, told: Outcome,
              refused: Optional[Outcome] = None) -> None:
        """A try has ended: the call waits before all others; `end` ends it if it may not be sent
        again."""
        call.told, call.refused, call.waits_since = told, refused, now
        self.waiting.insert(0, call)

    def answered(self, call: Call, outcome: Outcome, now: float, is_certain: bool) -> None:
        """A try has ended with a reply.

        Args:
            is_certain: whether no other reply was received, or may have been, since its request.
        """
        code = outcome.error_code
        if outcome.status != wire.INVALID:
            call.finish(outcome)
            return
        if code not in (wire.NOT_SYNCHRONISED, wire.CHECKSUM_MISMATCH):
            call.tries = 0
        may_be_done = call.told and not call.refused    # an earlier try
        self.again(call, now, unknown(
            f'received INVALID ({wire.describe_error(code)}), perhaps because of noise on the line',
            code), outcome if is_certain and not may_be_done else None)

    def end(self, outcome_of_call: Callable[[Call], Optional[Outcome]]) -> None:
        """End the calls that have an outcome now."""
        for call in list(self.waiting):
            outcome = outcome_of_call(call)
            if outcome:
                self.waiting.remove(call)
                call.finish(outcome)

    def end_but_stops(self, why: str, until: float) -> None:
        """End all calls that do not interrupt, and wait since then or longer."""
        self.end(lambda call: None if call.function.interrupts or call.waits_since > until
                 else call.without_reply(why))

    def doubt_refusals(self) -> None:
        """An OK was received, or may have been: an INVALID before it was perhaps for noise, so its
        call may have been executed; rule 4."""
        for call in self.waiting:
            call.refused = None

    def stop_again(self) -> None:
        """Send calls that interrupt again, before all else: what was sent may be lost; rule 8."""
        for call in self.waiting:
            call.is_urgent = call.function.interrupts


def outcome_of(reply: wire.Reply, request: wire.Request, round_trip: float,
               stamp: Any) -> Outcome:
    """The outcome of a request with this reply."""
    message = f'done: {request}'
    if reply.cmd1 in (wire.ERROR, wire.INVALID):
        who = 'the board refused' if reply.cmd1 == wire.ERROR else 'refused, nothing was executed'
        message = f'{who}: {wire.describe_error(reply.error_code)}'
    return Outcome(reply.cmd1, message, reply.error_code, reply.data, round_trip, True, stamp)


def unknown(why: str, code: int = 0) -> Outcome:
    """The outcome if the request may have been executed."""
    return Outcome(TIMEOUT, f'{why}: {UNKNOWN}', code)
