"""The Master on a robot-ctrl-bus: which request is sent when, and what a reply means to its call.

Without I/O and without a clock. Its link, which owns the port, reports what is received and when,
and asks for the `next` request. session.py has the states and transitions, call.py the calls.
"""
from collections import Counter, deque
from typing import Callable, Deque, Dict, NamedTuple, Optional

from ...framing.stream import CHECKSUM, Frame
from ...link.outcome import Outcome
from ...link.sparing_log import SparingLog
from . import wire
from .call import Call, OnSuccess, Queue, outcome_of, unknown
from .session import TRIES, Event, Exchange, Kind, Session, State, event_of

STALLED = 'it may have waited while the bridge stalled'
_PATIENCE = 0.8     # s that a call waits for a board that does not answer


class BusSettings(NamedTuple):
    """Parameters of the session; times are in s."""

    reply_timeout: float = 0.5
    motion_timeout: float = 5.0
    retries: int = 2                   # further tries of a repeatable request
    environment_period: float = 1.0    # 0: never
    environment_datelen: int = 2
    reply_has_cmd2: bool = False
    echo: bool = True                  # whether the board knows ECHO
    announcements: bool = False        # ask the board for its announcement after each connect


class Hooks(NamedTuple):
    """What the Master asks of its link."""

    nonce: Callable[[], bytes]                  # new bytes for an ECHO
    refuses: Callable[[wire.Function], str]     # why this is not sent to the board now; '': it is
    begun_anew: Callable[[float], None]         # the board may be another one, or was reset
    drop_output: Callable[[str], object]        # drop what may still wait on its way to the board


class Master:
    """See the module. All times are in s of one monotonic clock. Any thread may `submit`."""

    def __init__(self, settings: BusSettings, log: SparingLog, hooks: Hooks) -> None:
        self.session = Session(settings.echo, settings.reply_timeout, log)
        self.queue = Queue(max(settings.motion_timeout, TRIES * settings.reply_timeout))
        self.timeouts = 0
        self.data_errors: Dict[str, int] = Counter()         # in an OK, by cause
        self.round_trips: Deque[float] = deque(maxlen=200)   # s; the latest
        self._settings, self._log, self._hooks = settings, log, hooks
        self._stalled_at = float('-inf')    # the end of the latest stall

    def submit(self, request: wire.Request, function: wire.Function, now: float,
               on_success: Optional[OnSuccess] = None, is_poll: bool = False,
               refusal: str = '') -> Call:
        """Queue a call, from any thread, and return it; it gets an outcome whatever happens. With a
        `refusal` it has it at once."""
        moves = wire.built_in(request, function).moves      # a raw request may be one, too
        timeout = self._settings.motion_timeout if moves else self._settings.reply_timeout
        call = Call(request, function, function.timeout or timeout, 1 + self._settings.retries, now,
                    is_poll, on_success)
        if refusal:
            call.finish(call.without_reply(refusal))
        else:
            self.queue.submitted.append(call)
        return call

    def under_way(self) -> str:
        """What the board executes and must not be interrupted, for people; '': nothing."""
        call = self.session.call
        return '' if call is None or call.function.repeatable else f'"{call.request}" is under way'

    # -- events -------------------------------------------------------------------------

    def end(self, why: str, now: float) -> None:
        """The port is closed: every call has an outcome now."""
        call = self.session.happened(Event.CLOSED, now)
        if call:
            call.finish(unknown(f'the port closed before the reply arrived ({why})'))
        self.queue.end(lambda call: call.without_reply(f'the port is closed ({why})'))

    def doubt(self, why: str, now: float) -> None:
        """Replies may have been missed, and requests lost, on a port that stays open."""
        self.session.happened(Event.OTHER, now, why)
        self.queue.doubt_refusals()
        call = self.session.call
        if call and call.function.interrupts:
            self._interrupt('it was sent again before the reply', now)
        self.queue.stop_again()

    def stalled(self, now: float) -> None:
        """The bridge did not run: what moves and was asked for until now is too old; rule 9."""
        self._stalled_at = now
        self.doubt('the bridge stalled', now)

    def damaged(self, frame: Frame, now: float) -> None:
        """Bytes were received that are not a valid reply."""
        self.queue.doubt_refusals()
        # Only a frame with a wrong checksum can be the reply. After noise, for example during a
        # motion, the reply may still arrive.
        call = self.session.happened(Event.FAILED if frame.cause == CHECKSUM else Event.OTHER, now,
                                     'received bytes that are no valid reply')
        if call:
            self.queue.again(call, now, unknown('the reply was damaged'))

    def received(self, frame: Frame, now: float) -> None:
        """A valid reply was received."""
        reply, session = frame.message, self.session
        exchange, call, in_step = session.exchange, session.call, session.in_step
        event, error = event_of(reply, exchange), ''
        if reply.cmd1 == wire.OK:
            self.queue.doubt_refusals()
            if call and event is Event.ANSWER:
                error = self._data_error(call, reply)
        if error:       # without ECHO the right reply may follow
            event = Event.FAILED if self._settings.echo else Event.OTHER
        if event is Event.LOST and session.unanswered[Kind.ECHO] >= TRIES:
            event = Event.OTHER     # SYNC and ECHO do not alternate faster than ECHOs time out
        if event is Event.LOST or event is Event.ANSWER and reply.cmd1 == wire.SYNC:
            self._hooks.begun_anew(now)     # rule 12
        call = session.happened(event, now, f'received {reply}, no reply to '
                                f'{exchange.request if exchange else "a request"}')
        if call and exchange:
            outcome = outcome_of(reply, exchange.request, now - exchange.sent, frame.stamp)
            if error:
                outcome = outcome._replace(message=error, as_expected=False)
            self._answered(call, outcome, now, in_step)

    def not_sent(self, exchange: Exchange, why: str) -> None:
        """The request that `next` returned could not be written."""
        call = exchange.call
        if self.session.exchange is exchange:
            self.session.exchange = None
            if call and call.function.interrupts:
                self.queue.waiting.insert(0, call)
            elif call:
                call.finish(call.without_reply(why))
        self.queue.stop_again()     # what waited in the port is dropped, perhaps a stop, too

    # -- what to do ---------------------------------------------------------------------

    def tick(self, now: float) -> None:
        """Take the calls of other threads, and end what may not be sent, or waits for too long."""
        exchange, submitted = self.session.exchange, self.queue.submitted
        if exchange and now >= exchange.deadline:
            self._timed_out(exchange, now)
        while submitted:
            self._take(submitted.popleft(), now)
        self.queue.end(lambda call: self._outcome_of_waiting(call, now))

    def next(self, now: float, has_read_all: bool) -> Optional[Exchange]:
        """The request to write now, or None. It counts as sent, unless `not_sent` follows.

        Args:
            has_read_all: whether all that was received was taken in; only a stop does not wait.
        """
        session, call = self.session, self.queue.urgent()
        if call:
            call.is_urgent, call.refused = False, None
            call.told = unknown('no reply is known to be the one to this')
            return Exchange(Kind.CALL, call.request, now, now, call)    # it waits for its turn, too
        if not has_read_all or session.exchange or session.state is State.CLOSED:
            return None
        if not session.in_step:
            return self._probe(now)
        call = self.queue.next()
        if call is None:
            session.state = State.IN_STEP       # the line may stand before a call comes: rule 10
            return None
        needs_fence = call.function.cmd1 == wire.FUNCTION and not (
            call.is_poll and call.request == session.latest)        # rule 6
        if needs_fence and not session.is_fenced(now):
            return self._probe(now) if self._settings.echo else None
        self.queue.waiting.remove(call)
        call.tries -= 1
        return session.send(call.request, now, call.timeout, call)

    def _probe(self, now: float) -> Exchange:
        """Send what has to be answered before the next call; rules 2 and 6."""
        is_echo = self.session.synchronised and self._settings.echo
        return self.session.send(wire.echo(self._hooks.nonce()) if is_echo else wire.SYNC_REQUEST,
                                 now, self._settings.reply_timeout)

    def due(self, now: float) -> float:
        """When `tick` and `next` are to be called next, at the latest."""
        session = self.session
        times = [call.waits_since + self.queue.longest_wait for call in self.queue.waiting]
        if session.exchange:
            times.append(session.exchange.deadline)
        elif now < session.quiet_until:
            times.append(session.quiet_until)
        return min(times, default=float('inf'))

    # -- calls --------------------------------------------------------------------------

    def _take(self, call: Call, now: float) -> None:
        """A call was submitted."""
        outcome = self._outcome_of_waiting(call, now)
        if outcome:
            call.finish(outcome)        # what is not sent interrupts nothing
            return
        if call.function.interrupts:
            self._interrupt(f'{call.request} was sent before the reply', now)
            self.queue.end_but_stops(f'{call.request} was called', now)
            call.is_urgent = True
        call.waits_since = call.asked
        self.queue.waiting.append(call)

    def _outcome_of_waiting(self, call: Call, now: float) -> Optional[Outcome]:
        """The outcome of a call that must not be sent, or waits for too long; None if it waits."""
        session, is_repeatable = self.session, call.function.repeatable
        if call.refused and not call.tries and session.in_step:
            return call.refused         # an ECHO has returned since; rule 4
        if call.told and not call.refused and not (is_repeatable and call.tries):
            return call.told
        why = self._hooks.refuses(call.function)
        if session.state is State.CLOSED:
            why = 'the port is closed'
        elif call.asked <= self._stalled_at and not is_repeatable:
            why = STALLED
        elif call.outcome or now >= call.waits_since + self.queue.longest_wait \
                and not call.is_urgent:
            why = 'the bus is busy, or its line' if session.in_step else session.condition.text
        return call.without_reply(why) if why else None

    def _interrupt(self, why: str, now: float) -> None:
        """A stop is sent now, whatever is outstanding; rule 8."""
        call = self.session.happened(Event.STOP, now)
        if call:
            self.queue.again(call, now, unknown(why))

    def _data_error(self, call: Call, reply: wire.Reply) -> str:
        """What is wrong with the data of an OK, which is counted; '': nothing; rule 5."""
        if not self._settings.echo and reply.data and call.function.reply.is_empty:
            return 'it has data, so it is the reply to another request'
        cause, error = call.function.data_error(reply)
        if error:
            error = (f'the OK to "{call.request}" is invalid: {error}; check that the board\'s '
                     'firmware has the same layout')
            self.data_errors[cause] += 1
            self._log.warn('unexpected', error)
        return error

    def _answered(self, call: Call, outcome: Outcome, now: float, is_certain: bool) -> None:
        """The try of a call has ended with a reply.

        Args:
            is_certain: whether no other reply was received, or may have been, since its request.
        """
        self.round_trips.append(outcome.round_trip)
        code = outcome.error_code
        if outcome.status != wire.INVALID:
            call.finish(outcome)
            return
        if code not in (wire.NOT_SYNCHRONISED, wire.CHECKSUM_MISMATCH):
            call.tries = 0
        may_be_done = call.told and not call.refused    # an earlier try
        self.queue.again(call, now, unknown(
            f'received INVALID ({wire.describe_error(code)}), perhaps because of noise on the line',
            code), outcome if is_certain and self._settings.echo and not may_be_done else None)

    def _timed_out(self, exchange: Exchange, now: float) -> None:
        """The time for the reply is over; rule 3."""
        self.timeouts += 1
        call = self.session.happened(Event.TIMEOUT, now, 'no reply')
        if call is None:
            if self.session.unanswered[exchange.kind] >= TRIES:
                self.queue.end_but_stops(self.session.condition.text, now - _PATIENCE)
            self.queue.stop_again()
            return
        self._log.warn('timeout', f'no reply to "{call.request}" within {call.timeout:g} s')
        if not call.function.repeatable and not exchange.heard:
            self._hooks.drop_output('nothing received since a request, which may still wait')
        self.queue.again(call, now, unknown(f'no reply within {call.timeout:g} s'))
