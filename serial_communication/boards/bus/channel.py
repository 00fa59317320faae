"""The Master's session as a table: what may be sent, what is outstanding, and what changes that.

The rules are those of the bus chapter of doc/protocols.md; comments refer to them by their numbers.
"""
import enum
from collections import Counter
from dataclasses import dataclass
from typing import Callable, Dict, Optional

from ...link.session import ERROR, OK, WARN, Condition
from ...link.sparing_log import SparingLog
from . import wire
from .call import Call

TRIES = 3           # SYNCs or ECHOs in a row without an answer, after which no call is sent
SILENCE = 0.02      # s of silence as a fence: a USB adapter delivers bytes up to 16 ms late

READY = Condition(OK, 'ok', 'ready')
SYNCHRONISING = Condition(WARN, 'not_synchronised', 'synchronising')
NO_SYNC = Condition(ERROR, 'not_synchronised', 'the board does not answer SYNC')
OUT_OF_STEP = Condition(WARN, 'out_of_step', 'out of step')
NO_ECHO = Condition(ERROR, 'no_echo', 'the board does not answer ECHO (see bus/echo)')


class State(enum.Enum):
    """What may be sent next."""

    CLOSED = 'nothing: the port is closed'
    UNSYNCHRONISED = 'SYNC'
    OUT_OF_STEP = 'ECHO, or SYNC if the board knows none: a reply may still be under way'
    IN_STEP = 'SYNC, ECHO, or the same poll again; before any other request, a fence'
    FENCED = 'any request: no reply can be under way'


class Kind(enum.Enum):
    """What is outstanding."""

    SYNC = 'a SYNC of the Master itself, or nothing yet while the board is not synchronised'
    ECHO = 'an ECHO of the Master itself'
    CALL = 'the request of a call or a poll, or nothing'


class Event(enum.Enum):
    """What the Master receives, or does not."""

    ANSWER = 'the reply to what is outstanding'
    LOST = 'an INVALID "not synchronised"'
    FAILED = 'any other INVALID, a frame with a wrong checksum, an OK with data that does not fit'
    OTHER = 'any other reply; noise; something that may have been missed'
    TIMEOUT = 'the time for the reply is over'
    STOP = 'a call that interrupts is sent'
    CLOSED = 'the port is closed'


class Then(enum.Enum):
    """What becomes of what is outstanding."""

    WAIT = 'it stays outstanding'
    END = 'it has ended'
    RETRY = 'it has ended without a reply, and counts as unanswered'


SAME, CLOSED, LOST = None, State.CLOSED, State.UNSYNCHRONISED
OUT, FENCED = State.OUT_OF_STEP, State.FENCED
WAIT, END, RETRY = Then.WAIT, Then.END, Then.RETRY
# The state after an event, and what becomes of what is outstanding. Where a call has ended, the
# Master decides by rules 4, 5 and 7 whether it is sent again.
#
# Not in the table: the port opens (UNSYNCHRONISED); the request of a call is sent, or nobody needs
# a fence (IN_STEP); TRIES ECHOs in a row are not answered (UNSYNCHRONISED), and a SYNC is, of a
# board that knows no ECHO (IN_STEP).
TABLE = {
    #               SYNC           ECHO            CALL
    Event.ANSWER:  ((OUT, END),    (FENCED, END),  (SAME, END)),
    Event.LOST:    ((SAME, WAIT),  (LOST, RETRY),  (LOST, END)),
    Event.FAILED:  ((SAME, WAIT),  (OUT, WAIT),    (OUT, END)),
    Event.OTHER:   ((SAME, WAIT),  (OUT, WAIT),    (OUT, WAIT)),
    Event.TIMEOUT: ((LOST, RETRY), (OUT, RETRY),   (OUT, END)),
    Event.STOP:    ((SAME, END),   (OUT, END),     (OUT, END)),
    Event.CLOSED:  ((CLOSED, END), (CLOSED, END),  (CLOSED, END)),
}
TRANSITIONS = {event: dict(zip(Kind, row)) for event, row in TABLE.items()}


@dataclass
class Exchange:
    """A request and the wait for its reply."""

    kind: Kind
    request: wire.Request
    sent: float
    deadline: float
    call: Optional[Call] = None
    heard: bool = False     # a byte was received since


class Channel:
    """What may be sent, as the table says. All times are in s of one monotonic clock.

    Args:
        echoes: whether the board knows ECHO; if not, a silence is the fence: rule 6.
        reply_timeout: s; for SYNC and ECHO.
        nonce: returns new bytes for an ECHO.
    """

    def __init__(self, echoes: bool, reply_timeout: float, nonce: Callable[[], bytes],
                 log: SparingLog) -> None:
        self.state = State.CLOSED
        self.exchange: Optional[Exchange] = None    # what is outstanding
        self.unanswered: Dict[Kind, int] = Counter()    # SYNCs and ECHOs in a row
        self.quiet_until = 0.0      # without ECHO: a reply may be under way until then
        self.latest: Optional[wire.Request] = None      # of an exchange
        self._echoes, self._reply_timeout, self._nonce = echoes, reply_timeout, nonce
        self._log = log

    @property
    def synchronised(self) -> bool:
        """Whether the board has answered SYNC and is still synchronised."""
        return self.state not in (State.CLOSED, State.UNSYNCHRONISED)

    @property
    def in_step(self) -> bool:
        """Whether requests of calls may be sent."""
        return self.state in (State.IN_STEP, State.FENCED)

    @property
    def condition(self) -> Condition:
        """Whether calls are served, and if not, why."""
        if self.unanswered[Kind.SYNC]:
            return NO_SYNC
        if self.unanswered[Kind.ECHO] >= TRIES:
            return NO_ECHO
        if not self.synchronised:
            return SYNCHRONISING
        return READY if self.in_step else OUT_OF_STEP

    @property
    def call(self) -> Optional[Call]:
        """The call whose reply is expected, or None."""
        return self.exchange.call if self.exchange else None

    def begin(self) -> None:
        """The port is open: nothing is known about the board."""
        self.state = State.UNSYNCHRONISED
        self.unanswered.clear()

    def heard(self, at: float) -> None:
        """Bytes were received at this time, whatever they are."""
        self.quiet_until = max(self.quiet_until, at + SILENCE)
        if self.exchange and at > self.exchange.sent:
            self.exchange.heard = True

    def happened(self, event: Event, now: float, why: str = '') -> Optional[Call]:
        """Follow the table; return the call whose try has ended, or None. `why` is logged if calls
        could be sent, and can no longer."""
        call, was_in_step = self.call, self.in_step
        kind = self.exchange.kind if self.exchange else \
            Kind.CALL if self.synchronised else Kind.SYNC
        state, then = TRANSITIONS[event][kind]
        self.state = state or self.state
        if then is not WAIT:
            self.exchange = None
        if then is RETRY:
            self.unanswered[kind] += 1
            if kind is Kind.SYNC:
                self.unanswered[Kind.ECHO] = 0      # no board answers: this tells nothing of ECHO
            elif self.unanswered[kind] >= TRIES:
                self.state = LOST       # SYNC tells whether a board answers; ECHO follows
        elif event is Event.ANSWER:
            self.unanswered[kind] = 0
            if kind is Kind.SYNC and not self._echoes:
                # The reply was perhaps that to an earlier SYNC.
                self.state, self.quiet_until = State.IN_STEP, now + self._reply_timeout
            elif kind is Kind.SYNC and self.unanswered[Kind.ECHO] == TRIES:
                self._log.warn('no echo', 'the board answers SYNC but not ECHO, and no call is sent'
                               ' before that; for a board that knows no ECHO set bus/echo to false')
        if was_in_step and not self.in_step and why and event is not Event.STOP:
            self._log.warn('out of step', f'out of step: {why}')
        return None if then is WAIT else call

    def send(self, request: wire.Request, now: float, timeout: float,
             call: Optional[Call] = None) -> wire.Request:
        """Begin an exchange."""
        probe = Kind.ECHO if request.cmd1 == wire.ECHO else Kind.SYNC
        self.exchange = Exchange(Kind.CALL if call else probe, request, now, now + timeout, call)
        self.latest = request
        if call:
            self.state = State.IN_STEP
        return request

    def probe(self, now: float) -> wire.Request:
        """Send what has to be answered before the next call; rules 2 and 6."""
        is_echo = self.synchronised and self._echoes
        return self.send(wire.echo(self._nonce()) if is_echo else wire.SYNC_REQUEST, now,
                         self._reply_timeout)

    def may_send(self, call: Call, now: float) -> bool:
        """Whether this call may be sent before a probe; rule 6."""
        needs_fence = call.function.cmd1 == wire.FUNCTION and not (
            call.is_poll and call.request == self.latest)
        return self.in_step and (not needs_fence or self.is_fenced(now))

    def is_fenced(self, now: float) -> bool:
        """Whether no reply can be under way; rule 6."""
        return self.state is State.FENCED if self._echoes else now >= self.quiet_until

    def due(self, now: float) -> float:
        """When time alone changes something."""
        if self.exchange:
            return self.exchange.deadline
        return self.quiet_until if now < self.quiet_until else float('inf')

    def event_of(self, reply: wire.Reply) -> Event:
        """What the table calls the receipt of this reply."""
        exchange = self.exchange
        if reply.cmd1 == wire.INVALID:
            return Event.LOST if reply.error_code == wire.NOT_SYNCHRONISED else Event.FAILED
        if exchange is None:
            return Event.OTHER
        request = exchange.request
        if reply.cmd1 == wire.ERROR:
            is_answer = exchange.call is not None
        elif request.cmd1 == wire.ECHO:
            is_answer = reply.cmd1 == wire.ECHO and reply.data == request.data
        else:
            is_answer = reply.cmd1 == (wire.SYNC if request.cmd1 == wire.SYNC else wire.OK)
        return Event.ANSWER if is_answer else Event.OTHER
