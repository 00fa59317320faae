"""The Master's session on a robot-ctrl-bus: what may be sent when, and what an answer means.

A state machine without I/O and without a clock: whoever owns the port says what came and what
time it is, asks `next_request` what to send, and sleeps until `deadline`. The rules it keeps:

1. One request is outstanding, ever. Callers queue; calls go before polls.
2. After a connect, and after INVALID "not synchronised", SYNC until the board answers.
3. No reply within its timeout: the request's outcome is unknown.
4. What moves something, and raw requests, are sent again only where a reply said that nothing
   was executed.
   A board may also send INVALID for noise, and execute the request behind it: before a move is
   sent again or given up, an ECHO must return. After an OK that comes before it, nobody knows.
5. Replies carry no number. After a timeout, a damaged reply or one that nobody asked for, the
   link is out of step: an ECHO with a fresh nonce goes out, and all is dropped until that very
   echo is back. A board that never echoes gets a SYNC and a silence instead.
"""
import os
import threading
from collections import deque
from typing import Callable, Deque, List, NamedTuple, Optional

from ..protocols import robot_ctrl_bus as bus
from ..protocols.framing import CHECKSUM, Frame
from .sparing_log import SparingLog

NOT_SENT = 253     # refused here: nothing left the port
TIMEOUT = 254      # the outcome is unknown: executed once or not at all
ECHO_TRIES = 3     # unanswered ECHOs before a SYNC and a silence take their place
PATIENCE = 0.8     # s that a call waits for a link that serves nobody


class Outcome(NamedTuple):
    """What became of a call, as the caller is told it."""

    status: int              # the reply's CMD1, NOT_SENT or TIMEOUT
    message: str             # for a person
    error_code: int = 0
    data: bytes = b''
    round_trip: float = 0.0  # s

    @property
    def success(self) -> bool:
        """Executed, exactly once."""
        return self.status in (bus.SYNC, bus.ECHO, bus.OK)


class Call:
    """One request on its way, shared by the caller, who waits, and the link, which serves it.

    Args:
        request: what to ask.
        timeout: s from sending to the reply.
        repeatable: whether it may be sent again when its outcome is unknown.
        tries: how often it may be sent in all.
        now: the time of the call.
        poll: nobody waits for it: every other call goes first.
    """

    def __init__(self, request: bus.Request, timeout: float, repeatable: bool, tries: int,
                 now: float, poll: bool = False) -> None:
        self.request = request
        self.timeout = timeout
        self.repeatable = repeatable
        self.tries = tries
        self.submitted = now
        self.poll = poll
        self.setback: Optional[Outcome] = None   # how the try before this one ended
        self.doubtful = False    # whether that may have been said of noise, not of this
        self.outcome: Optional[Outcome] = None
        self._sent = False
        self._lock = threading.Lock()
        self._done = threading.Event()

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
            self.finish(Outcome(TIMEOUT, 'the bridge is stuck; it is not known whether this '
                                         'was executed') if self._sent else
                        Outcome(NOT_SENT, 'the bridge is stuck; nothing was sent'))
        return self.outcome


class _Exchange(NamedTuple):
    """The request that is outstanding."""

    kind: str                 # one of those below
    request: bus.Request
    sent: float
    deadline: float
    call: Optional[Call] = None


_SYNC, _ECHO, _SILENCE, _CALL = 'sync', 'echo', 'silence', 'call'


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
        self.timeouts = 0
        self.round_trips: Deque[float] = deque(maxlen=200)
        self.in_step = True
        self.synchronised = False
        self._reply_timeout = reply_timeout
        self._turn = max(motion_timeout, PATIENCE)
        self._log = log
        self._nonce = nonce
        self._connected = False
        self._inbox: Deque[Call] = deque()      # from other threads
        self._calls: Deque[Call] = deque()
        self._polls: Deque[Call] = deque()
        self._again: Optional[Call] = None      # goes first: it was sent, in vain
        self._exchange: Optional[_Exchange] = None
        self._served_until = 0.0                # when the latest call's exchange ended
        self._unanswered_echoes = 0
        self._echoes: Optional[bool] = None     # whether this board answers ECHO at all
        self._unanswered_syncs = 0

    # -- calls ------------------------------------------------------------------------

    def submit(self, call: Call) -> None:
        """Queue a call; any thread. The outcome arrives in the call."""
        self._inbox.append(call)

    # -- what happened ------------------------------------------------------------------

    def connected(self, now: float) -> None:
        """The port is open: nothing is known of the board."""
        self._connected = True
        self.synchronised = False
        self._echoes = None
        self._unanswered_echoes = 0
        self._unanswered_syncs = 0

    def disconnected(self, now: float, why: str) -> None:
        """The port has closed: everybody is told."""
        self._connected = False
        self.synchronised = False
        exchange, self._exchange = self._exchange, None
        if exchange and exchange.call:
            self.in_step = False
            exchange.call.finish(Outcome(
                TIMEOUT, 'the port closed before the reply came (%s): %s' % (why, _UNKNOWN)))
        self._take_in()

    def received(self, frame: Frame, now: float) -> None:
        """A sound reply has come."""
        reply = frame.message
        exchange = self._exchange
        again = self._again
        if (again is not None and again.doubtful and reply.cmd1 not in (bus.ERROR, bus.INVALID)
                and _answers(reply, again.request)):
            # Either the INVALID was for noise and this is the reply, or this is another's.
            self._again = None
            again.finish(_not_known(again.setback))
        elif (reply.cmd1 == bus.INVALID and reply.error_code == bus.NOT_SYNCHRONISED
                and (exchange is None or exchange.kind == _SILENCE)):
            self._exchange = None
            self.synchronised = False
            self._out_of_step(f'{reply}')
        elif exchange is None:
            self._out_of_step(f'a reply that nobody asked for: {reply}')
        elif exchange.kind == _CALL:
            self._call_answered(exchange, reply, now)
        elif exchange.kind == _SYNC:
            self._sync_answered(reply, now)
        elif exchange.kind == _ECHO:
            self._echo_answered(exchange, reply, now)
        else:
            self._expect_silence(now)

    def damaged(self, frame: Frame, now: float) -> None:
        """Bytes have come that are no sound reply."""
        exchange = self._exchange
        if exchange is not None and exchange.kind == _SILENCE:
            self._expect_silence(now)
            return
        self._out_of_step('damaged bytes')
        if exchange is not None and exchange.kind == _CALL and frame.cause == CHECKSUM:
            # It has the form of a reply. Plain noise may come while a motion lasts, and the
            # reply behind it is good: for that, wait on.
            outcome = Outcome(TIMEOUT, 'the reply was damaged: ' + _UNKNOWN)
            if exchange.call.repeatable:
                self._try_again(exchange, now, outcome)
            else:
                self._finish(exchange, now, outcome)

    # -- what to do ---------------------------------------------------------------------

    def tick(self, now: float) -> None:
        """Time has passed, or a call was submitted."""
        self._take_in()
        exchange = self._exchange
        if exchange is not None and now >= exchange.deadline:
            self._timed_out(exchange, now)
        self._expire(now)

    @property
    def outstanding(self) -> bool:
        """Whether a request waits for its reply."""
        return self._exchange is not None

    def condition(self) -> str:
        """What is amiss with the board, in a few words; empty if nothing is."""
        if not self.synchronised:
            return ('the board does not answer SYNC' if self._unanswered_syncs
                    else 'synchronising')
        if not self.in_step:
            return ('the board does not answer ECHO' if self._unanswered_echoes
                    else 'out of step')
        return ''

    def deadline(self) -> Optional[float]:
        """When `tick` must be called at the latest."""
        times = [self._limit(call) for call in self._waiting()]
        if self._exchange is not None:
            times.append(self._exchange.deadline)
        return min(times) if times else None

    def wants_to_send(self) -> bool:
        """Whether `next_request` has one."""
        if not self._connected or self._exchange is not None:
            return False
        return bool(not self.synchronised or not self.in_step or self._again or self._calls
                    or self._polls)

    def next_is_final(self) -> bool:
        """Whether the next request is one that a stray reply must not seem to answer."""
        if not (self.synchronised and self.in_step):
            return False
        call = self._again or (self._calls and self._calls[0])
        return bool(call) and not call.repeatable

    def next_request(self, now: float) -> Optional[bus.Request]:
        """The request to send now, which is outstanding from here on."""
        if not self.wants_to_send():
            return None
        if not self.synchronised:
            return self._send(_SYNC, bus.SYNC_REQUEST, now)
        if not self.in_step:
            if self._echoes is not False and self._unanswered_echoes < ECHO_TRIES:
                return self._send(_ECHO, bus.echo(self._nonce()), now)
            return self._send(_SYNC, bus.SYNC_REQUEST, now)
        while self._again or self._calls or self._polls:
            if self._again:
                call, self._again = self._again, None
                if not call.tries:
                    call.finish(call.setback)
                    continue
                call.doubtful = False
            else:
                call = (self._calls or self._polls).popleft()
            if call.claim():
                self._exchange = _Exchange(_CALL, call.request, now, now + call.timeout, call)
                return call.request
        return None

    def not_sent(self, why: str) -> None:
        """The request that `next_request` gave did not leave the port."""
        exchange, self._exchange = self._exchange, None
        if exchange is not None and exchange.call:
            exchange.call.finish(exchange.call.setback
                                 or Outcome(NOT_SENT, '%s; nothing was sent' % why))

    # -- inside -------------------------------------------------------------------------

    def _send(self, kind: str, request: bus.Request, now: float) -> bus.Request:
        self._exchange = _Exchange(kind, request, now, now + self._reply_timeout)
        return request

    def _out_of_step(self, why: str) -> None:
        if self.in_step:
            self._log.warn('out of step', 'out of step: %s; finding it again with an ECHO' % why)
        self.in_step = False

    def _call_answered(self, exchange: _Exchange, reply: bus.Reply, now: float) -> None:
        request = exchange.request
        if not _answers(reply, request):
            # Somebody else's, or an echo of other bytes. The right one may still come.
            self._out_of_step(f'{reply} to {request}')
            return
        round_trip = now - exchange.sent
        self.round_trips.append(round_trip)
        outcome = _told(reply, request, round_trip)
        if reply.cmd1 == bus.ECHO:
            self._echoes = True
        if reply.cmd1 != bus.INVALID:
            self._finish(exchange, now, outcome)
            return
        call, code = exchange.call, reply.error_code
        if code == bus.NOT_SYNCHRONISED:
            self.synchronised = False
        elif code != bus.CHECKSUM_MISMATCH:
            call.tries = 0
        if code != bus.NOT_SYNCHRONISED and not call.repeatable:
            call.doubtful = True
            self.in_step = False
            self._hold(exchange, now, outcome)
        else:
            self._try_again(exchange, now, outcome)

    def _sync_answered(self, reply: bus.Reply, now: float) -> None:
        if reply.cmd1 == bus.SYNC:
            self._exchange = None
            self._unanswered_syncs = 0
            if not self.synchronised:
                self.synchronised = True
            elif not self.in_step:
                # In place of an echo: after this SYNC, a silence.
                self._expect_silence(now)
        elif reply.cmd1 != bus.INVALID:     # INVALID: damaged on the way; asked again in time
            self._out_of_step(f'{reply} to SYNC')

    def _echo_answered(self, exchange: _Exchange, reply: bus.Reply, now: float) -> None:
        if reply.cmd1 == bus.ECHO and reply.data == exchange.request.data:
            self._exchange = None
            self._echoes = True
            self._unanswered_echoes = 0
            self.in_step = True
        elif reply.cmd1 == bus.INVALID and reply.error_code == bus.NOT_SYNCHRONISED:
            self._exchange = None
            self.synchronised = False
            self._echo_unanswered()

    def _expect_silence(self, now: float) -> None:
        self._exchange = _Exchange(_SILENCE, bus.SYNC_REQUEST, now, now + self._reply_timeout)

    def _timed_out(self, exchange: _Exchange, now: float) -> None:
        self._exchange = None
        if exchange.kind == _SILENCE:
            self.in_step = True
            self._unanswered_echoes = 0
            return
        self.timeouts += 1
        if exchange.kind == _SYNC:
            self.synchronised = False
            self.in_step = False     # its reply may still come, behind that of the next
            self._unanswered_syncs += 1
            self._log.warn('no answer', 'the board does not answer SYNC; asking on')
        elif exchange.kind == _ECHO:
            self._echo_unanswered()
        else:
            self._log.warn('timeout', f'no reply to "{exchange.request}" within '
                           f'{exchange.call.timeout:g} s')
            self._out_of_step('no reply')
            outcome = Outcome(TIMEOUT, 'no reply within %g s: %s'
                              % (exchange.call.timeout, _UNKNOWN))
            if exchange.call.repeatable:
                self._try_again(exchange, now, outcome)
            else:
                self._finish(exchange, now, outcome)

    def _echo_unanswered(self) -> None:
        self._unanswered_echoes += 1
        if self._unanswered_echoes == ECHO_TRIES:
            self._log.warn('no echo', 'the board does not answer ECHO; a SYNC and %g s of '
                           'silence take its place' % self._reply_timeout)
            self._echoes = self._echoes or False

    def _try_again(self, exchange: _Exchange, now: float, outcome: Outcome) -> None:
        """Once more, or tell the caller that this was the last try."""
        if exchange.call.tries:
            self._hold(exchange, now, outcome)
        else:
            self._finish(exchange, now, outcome)

    def _hold(self, exchange: _Exchange, now: float, outcome: Outcome) -> None:
        self._exchange = None
        self._served_until = now
        call = exchange.call
        call.setback = outcome
        if call.poll:
            self._polls.appendleft(call)    # behind every call
        else:
            self._again = call

    def _finish(self, exchange: _Exchange, now: float, outcome: Outcome) -> None:
        self._exchange = None
        self._served_until = now
        exchange.call.finish(outcome)

    def _waiting(self) -> List[Call]:
        waiting = list(self._calls) + list(self._polls)
        if self._again:
            waiting.append(self._again)
        return waiting

    def _limit(self, call: Call) -> float:
        """Until when a queued call waits for its turn: not long for a board that is deaf."""
        if call.doubtful:
            return min(self._served_until + max(call.timeout, PATIENCE),
                       call.submitted + self._turn + call.timeout)
        turn = max(call.submitted, self._served_until if call.setback else 0.0) + self._turn
        serving = self._exchange is not None and self._exchange.kind == _CALL
        if serving or (self.in_step and self.synchronised and not call.setback):
            return turn
        # An ECHO may be answered only after what the board is busy with: a move, say.
        patience = max(PATIENCE, call.timeout) if self.synchronised else PATIENCE
        return min(turn, max(call.submitted, self._served_until) + patience)

    def _take_in(self) -> None:
        while self._inbox:
            call = self._inbox.popleft()
            (self._polls if call.poll else self._calls).append(call)
        if not self._connected:
            self._refuse_all('the port is closed')

    def _expire(self, now: float) -> None:
        for call in self._waiting():
            if call.outcome is not None:      # its caller has gone
                self._forget(call)
            elif now >= self._limit(call):
                self._drop(call, self._why_not())

    def _why_not(self) -> str:
        if not self._connected:
            return 'the port is closed'
        return self.condition() or 'the bus is busy with other calls'

    def _forget(self, call: Call) -> None:
        if call is self._again:
            self._again = None
            return
        for queue in (self._calls, self._polls):
            try:
                queue.remove(call)
            except ValueError:
                pass

    def _refuse_all(self, why: str) -> None:
        for call in self._waiting():
            self._drop(call, why)

    def _drop(self, call: Call, why: str) -> None:
        """A queued call is not sent, or not sent again."""
        self._forget(call)
        if call.doubtful:
            call.finish(_not_known(call.setback))
        elif call.request == bus.SYNC_REQUEST:
            call.finish(call.setback or Outcome(NOT_SENT, why))     # the link's own may have left
        else:
            call.finish(call.setback or Outcome(NOT_SENT, '%s; nothing was sent' % why))


_UNKNOWN = 'it is not known whether this was executed; look before you repeat it'


def _not_known(invalid: Outcome) -> Outcome:
    """Of an INVALID that may have been said of noise before the request."""
    return Outcome(TIMEOUT, 'the board said INVALID (%s), perhaps of noise on the line: %s'
                   % (bus.describe_error(invalid.error_code), _UNKNOWN), invalid.error_code)


def _told(reply: bus.Reply, request: bus.Request, round_trip: float) -> Outcome:
    """The outcome that a reply means."""
    code = reply.error_code
    if reply.cmd1 == bus.INVALID:
        message = 'refused, nothing was executed: %s' % bus.describe_error(code)
    elif reply.cmd1 == bus.ERROR:
        message = 'the board refused: %s' % bus.describe_error(code)
    else:
        message = f'done: {request}'
    return Outcome(reply.cmd1, message, code, reply.data, round_trip)


def _answers(reply: bus.Reply, request: bus.Request) -> bool:
    """Whether this can be the reply to that."""
    if reply.cmd1 in (bus.ERROR, bus.INVALID):
        return True
    if request.cmd1 == bus.ECHO:
        return reply.cmd1 == bus.ECHO and reply.data == request.data
    if request.cmd1 == bus.SYNC:
        return reply.cmd1 == bus.SYNC
    if reply.cmd1 != bus.OK:
        return False
    if request == bus.ENVIRONMENT_REQUEST:
        return len(reply.data) == bus.Environment.LAYOUT.size
    if request.cmd1 == bus.FUNCTION and request.cmd2 in (bus.LIFT, bus.GIMBAL):
        return not reply.data     # an OK with data was meant for another request
    return True
