"""The Master's session as a table: what may be sent, what is outstanding, and what changes that.

The rules are those of the bus chapter of doc/protocols.md. Comments here, in call.py and in
master.py refer to them by their numbers.
"""
import enum
from collections import Counter
from dataclasses import dataclass
from typing import Callable, Dict, Optional, Tuple

from ...link.sparing_log import SparingLog
from . import wire

ECHO_TRIES = 3         # ECHOs in a row without an answer, after which no call is sent


class SessionState(enum.Enum):
    """What may be sent next."""

    CLOSED = 'nothing: the port is closed'
    UNSYNCHRONISED = 'SYNC'
    OUT_OF_STEP = 'ECHO, or SYNC if the board knows none: a reply may still be under way'
    IN_STEP = 'SYNC, ECHO, or the same poll again; before any other request, a fence'
    FENCED = 'any request: no reply can be under way'


class Condition(enum.Enum):
    """Why the link cannot serve calls, for diagnostics; '' if it can."""

    READY = ''
    SYNCHRONISING = 'synchronising'
    NO_SYNC = 'the board does not answer SYNC'
    OUT_OF_STEP = 'out of step'
    NO_ECHO = 'the board does not answer ECHO (see bus/echo)'


class Kind(enum.Enum):
    """What is outstanding."""

    NOTHING = 'nothing'
    SYNC = 'a SYNC of the Master itself'
    ECHO = 'an ECHO of the Master itself'
    CALL = 'the request of a call or a poll'


class Event(enum.Enum):
    """What the Master receives, or does not."""

    ANSWER = 'the reply to what is outstanding, but no INVALID'
    UNSYNCHRONISED = 'an INVALID "not synchronised"'
    INVALID = 'an INVALID with any other code'
    OTHER = 'any other reply'
    WRONG_DATA = 'an OK whose data has a wrong length or impossible values'
    DAMAGED = 'a frame with a wrong checksum'
    NOISE = 'other bytes that are not a valid reply'
    MISSED = 'replies may have been received and dropped'
    TIMEOUT = 'the time for the reply is over'
    STOP = 'a call that interrupts is sent'


class Then(enum.Enum):
    """What becomes of what is outstanding."""

    WAIT = 'it stays outstanding'
    END = 'it has ended'
    RETRY = 'it has ended without a reply, and counts as unanswered'


_SAME = None
_OUT = SessionState.OUT_OF_STEP
_LOST = SessionState.UNSYNCHRONISED
_FENCED = SessionState.FENCED

Transition = Tuple[Optional[SessionState], Then]


def _rows(otherwise: Transition, **others: Transition) -> Dict[Event, Transition]:
    return {event: others.get(event.name, otherwise) for event in Event}


# The state afterwards for each event, and what becomes of what is outstanding. Where a call has
# ended, `Master` decides by rules 4, 5 and 7 whether it is sent again or has an outcome.
#
# Not in the table: the port opens (UNSYNCHRONISED) and closes (CLOSED), a request of a call is sent
# (IN_STEP), three ECHOs in a row are not answered (UNSYNCHRONISED), and a SYNC is, of a board that
# knows no ECHO (IN_STEP).
TRANSITIONS: Dict[Kind, Dict[Event, Transition]] = {
    Kind.NOTHING: _rows(                               # a board that is not synchronised stays so
        (_OUT, Then.WAIT),
        UNSYNCHRONISED=(_LOST, Then.WAIT)),
    Kind.SYNC: _rows(                                  # rule 2
        (_SAME, Then.WAIT),
        ANSWER=(_OUT, Then.END),
        TIMEOUT=(_LOST, Then.RETRY),
        STOP=(_SAME, Then.END)),
    Kind.ECHO: _rows(                                  # rule 6
        (_OUT, Then.WAIT),
        ANSWER=(_FENCED, Then.END),
        UNSYNCHRONISED=(_LOST, Then.RETRY),
        TIMEOUT=(_OUT, Then.RETRY),
        STOP=(_OUT, Then.END)),
    Kind.CALL: _rows(                                  # after INVALID, an ECHO: rule 4
        (_OUT, Then.END),
        ANSWER=(_SAME, Then.END),
        UNSYNCHRONISED=(_LOST, Then.END),
        OTHER=(_OUT, Then.WAIT),                       # the right reply may follow
        NOISE=(_OUT, Then.WAIT),
        MISSED=(_OUT, Then.WAIT)),
}


@dataclass
class Exchange:
    """What is outstanding: a request, or nothing."""

    kind: Kind
    request: wire.Request
    sent: float
    deadline: float


NOTHING = Exchange(Kind.NOTHING, wire.SYNC_REQUEST, 0.0, float('inf'))


class Session:
    """The base of `Master`: the state, and the exchanges that need no caller."""

    def __init__(self, reply_timeout: float, log: SparingLog, nonce: Callable[[], bytes],
                 begun_anew: Callable[[float], None], echoes: bool) -> None:
        self.state = SessionState.CLOSED
        self._exchange = NOTHING
        self._latest_request: Optional[wire.Request] = None
        self._fenced_at = 0.0          # when the latest fence was complete
        self._last_bytes = 0.0         # when the latest bytes were received
        self._silence = 0.0            # s since then, before a request where no ECHO is known
        self._unanswered: Dict[Kind, int] = Counter()     # SYNCs and ECHOs in a row
        self._reply_timeout = reply_timeout
        self._log = log
        self._nonce = nonce
        self._begun_anew = begun_anew
        self._echoes = echoes          # bus/echo

    def connected(self, now: float) -> None:
        """The port is open: nothing is known about the board."""
        self.state = SessionState.UNSYNCHRONISED
        self._unanswered.clear()
        self._last_bytes = now

    def bytes_came(self, at: float) -> None:
        """The latest bytes were received at this time, whatever they are."""
        self._last_bytes = max(self._last_bytes, at)

    @property
    def synchronised(self) -> bool:
        """Whether the board has answered SYNC and is still synchronised."""
        return self.state not in (SessionState.CLOSED, SessionState.UNSYNCHRONISED)

    @property
    def in_step(self) -> bool:
        """Whether requests of calls may be sent."""
        return self.state in (SessionState.IN_STEP, SessionState.FENCED)

    def condition(self) -> Condition:
        """Whether the link can serve calls, and if not, why."""
        if self._unanswered[Kind.SYNC]:
            return Condition.NO_SYNC
        if self._unanswered[Kind.ECHO] >= ECHO_TRIES:
            return Condition.NO_ECHO
        if not self.synchronised:
            return Condition.SYNCHRONISING
        return Condition.READY if self.in_step else Condition.OUT_OF_STEP

    def _begin(self, exchange: Exchange) -> wire.Request:
        """Send the request of an exchange."""
        self._exchange = exchange
        self._latest_request = exchange.request
        return exchange.request

    def _probe(self, now: float) -> wire.Request:
        """Send what has to be answered before the next call, SYNC or ECHO; rules 2 and 6."""
        is_echo = self.synchronised and self._echoes
        request = wire.echo(self._nonce()) if is_echo else wire.SYNC_REQUEST
        return self._begin(Exchange(Kind.ECHO if is_echo else Kind.SYNC, request, now,
                                    now + self._reply_timeout))

    def _happened(self, event: Event, now: float, why: str = '') -> None:
        """Follow the table; `why` is logged if calls could be sent, and can no longer."""
        exchange, was_in_step = self._exchange, self.in_step
        state, then = TRANSITIONS[exchange.kind][event]
        if state is not None and (self.synchronised or exchange is not NOTHING):
            self.state = state
        if why and was_in_step and not self.in_step:
            self._log.warn('out of step',
                           f'out of step: {why}; sending {"ECHO" if self._echoes else "SYNC"} '
                           'to get in step again')
        if state is _LOST:
            self._begun_anew(now)
        elif state is _FENCED:
            self._fenced_at = now
        if then is not Then.WAIT:
            self._exchange = NOTHING
        if then is Then.RETRY:
            self._unanswered[exchange.kind] += 1
            if exchange.kind is Kind.SYNC:
                self._unanswered[Kind.ECHO] = 0     # no board answers: this tells nothing of ECHO
            elif self._unanswered[Kind.ECHO] >= ECHO_TRIES:
                self.state = _LOST      # SYNC tells whether a board answers; ECHO follows

    def _own_answered(self, reply: wire.Reply, now: float) -> None:
        """A reply was received while no request of a call is outstanding."""
        kind, request = self._exchange.kind, self._exchange.request
        is_answer = reply.cmd1 == request.cmd1 and may_answer(reply, request)
        event = event_of(reply, is_answer)
        if kind is Kind.ECHO and self._unanswered[kind] >= ECHO_TRIES \
                and event is Event.UNSYNCHRONISED:
            event = Event.OTHER     # SYNC is sent at its timeout, not as fast as it is refused
        if kind is Kind.NOTHING:
            why = f'received a reply without a request: {reply}'
        else:
            why = f'{reply} to {kind.name}' if event is not Event.UNSYNCHRONISED else ''
        self._happened(event, now, why)
        if is_answer and kind in (Kind.SYNC, Kind.ECHO):
            self._unanswered[kind] = 0
            if kind is Kind.SYNC:
                self._begun_anew(now)
                if self._unanswered[Kind.ECHO] == ECHO_TRIES:
                    self._log.warn(
                        'no echo', 'the board answers SYNC but not ECHO, and no call is sent '
                        'before it does; for a board that knows no ECHO set bus/echo to false')
                if not self._echoes:
                    self.state, self._silence = SessionState.IN_STEP, self._reply_timeout


def event_of(reply: wire.Reply, is_answer: bool) -> Event:
    """What the table calls the receipt of this reply."""
    if reply.cmd1 == wire.INVALID:
        is_lost = reply.error_code == wire.NOT_SYNCHRONISED
        return Event.UNSYNCHRONISED if is_lost else Event.INVALID
    return Event.ANSWER if is_answer else Event.OTHER


def may_answer(reply: wire.Reply, request: wire.Request) -> bool:
    """Whether a reply of this type can be the reply to that request."""
    if reply.cmd1 in (wire.ERROR, wire.INVALID):
        return True
    if request.cmd1 == wire.ECHO:
        return reply.cmd1 == wire.ECHO and reply.data == request.data
    return reply.cmd1 == (wire.SYNC if request.cmd1 == wire.SYNC else wire.OK)
