"""The Master on a robot-ctrl-bus: which request is sent when, and what a reply means to its call.

Without I/O and without a clock. Its link, which owns the port, reports what is received and when,
and asks for the `next` request. session.py has the states and transitions, call.py the calls.
"""
from collections import Counter, deque
from typing import Callable, Deque, Dict, NamedTuple, Optional

from ...framing.stream import CHECKSUM, Frame
from ...link.freshness import STALL
from ...link.outcome import Outcome
from ...link.session import Doubt
from ...link.sparing_log import SparingLog
from . import wire
from .call import Call, OnSuccess, Queue, outcome_of, unknown
from .session import TRIES, Channel, Event, Exchange, Kind, State, event_of

STALLED = 'it may have waited while the bridge stalled'
_PATIENCE = 0.8     # s that a call waits for a board that does not answer


class MasterOptions(NamedTuple):
    """Parameters of the session; times are in s."""

    reply_timeout: float = 0.5
    motion_timeout: float = 5.0
    retries: int = 2                   # further tries of a repeatable request
    environment_datelen: int = 2
    reply_has_cmd2: bool = False
    echo: bool = True                  # whether the board knows ECHO
    announcements: bool = False        # ask the board for its announcement after each connect


class Master:
    """See the module. All times are in s of one monotonic clock.

    Args:
        nonce: returns new bytes for an ECHO.
        refuses: why a function is not sent to the board now; '': it is.
        begun_anew: called with the time when the board may be another one, or was reset.
    """

    def __init__(self, options: MasterOptions, log: SparingLog, nonce: Callable[[], bytes],
                 refuses: Callable[[wire.Function], str],
                 begun_anew: Callable[[float], None]) -> None:
        self.channel = Channel(options.echo, options.reply_timeout, log)
        self.queue = Queue(max(options.motion_timeout, TRIES * options.reply_timeout))
        self.timeouts = 0
        self.data_errors: Dict[str, int] = Counter()         # in an OK, by cause
        self.round_trips: Deque[float] = deque(maxlen=200)   # s; the latest
        self._options, self._log = options, log
        self._nonce, self._refuses, self._begun_anew = nonce, refuses, begun_anew
        self._ticked_at = self._stalled_at = float('-inf')      # the end of the latest stall

    def make(self, request: wire.Request, function: wire.Function, now: float,
             on_success: Optional[OnSuccess] = None, is_poll: bool = False) -> Call:
        """A call, to be submitted."""
        moves = wire.BUILT_IN.get(request[:2], function).moves      # a raw request may be one, too
        timeout = self._options.motion_timeout if moves else self._options.reply_timeout
        return Call(request, function, function.timeout or timeout, 1 + self._options.retries, now,
                    is_poll, on_success)

    # -- events -------------------------------------------------------------------------

    def begin(self, now: float) -> None:
        """The port was opened."""
        self.channel.begin()
        self._ticked_at = now

    def end(self, why: str, now: float) -> None:
        """The port is closed: every call has an outcome now."""
        call = self.channel.happened(Event.CLOSED, now)
        if call:
            call.finish(unknown(f'the port closed before the reply arrived ({why})'))
        self.queue.end(lambda call: call.without_reply(f'the port is closed ({why})'))

    def doubt(self, why: str, now: float) -> None:
        """Replies may have been missed, and requests lost, on a port that stays open. If that is so
        because the bridge did not run, what moves and was asked for until now is too old; rule 9.
        """
        if now - self._ticked_at > STALL:
            self._stalled_at = now
        self.channel.happened(Event.OTHER, now, why)
        self.queue.doubt_refusals()
        call = self.channel.call
        if call and call.function.interrupts:
            self._interrupt('it was sent again before the reply', now)
        self.queue.stop_again()

    def damaged(self, frame: Frame, now: float) -> None:
        """Bytes were received that are not a valid reply."""
        self.queue.doubt_refusals()
        # Only a frame with a wrong checksum can be the reply. After noise, for example during a
        # motion, the reply may still arrive.
        call = self.channel.happened(Event.FAILED if frame.cause == CHECKSUM else Event.OTHER, now,
                                     'received bytes that are no valid reply')
        if call:
            self.queue.again(call, now, unknown('the reply was damaged'))

    def received(self, frame: Frame, now: float) -> None:
        """A valid reply was received."""
        reply, channel = frame.message, self.channel
        exchange, call, in_step = channel.exchange, channel.call, channel.in_step
        event, error = event_of(reply, exchange), ''
        if reply.cmd1 == wire.OK:
            self.queue.doubt_refusals()
            if call and event is Event.ANSWER:
                error = self._data_error(call, reply)
        if error:       # without ECHO the right reply may follow
            event = Event.FAILED if self._options.echo else Event.OTHER
        if event is Event.LOST and channel.unanswered[Kind.ECHO] >= TRIES:
            event = Event.OTHER     # SYNC and ECHO do not alternate faster than ECHOs time out
        if event is Event.LOST or event is Event.ANSWER and reply.cmd1 == wire.SYNC:
            self._begun_anew(now)     # rule 12
        call = channel.happened(event, now, f'received {reply}, no reply to '
                                f'{exchange.request if exchange else "a request"}')
        if call and exchange:
            outcome = outcome_of(reply, exchange.request, now - exchange.sent, frame.stamp)
            if error:
                outcome = outcome._replace(message=error, as_expected=False)
            self._answered(call, outcome, now, in_step)

    def not_sent(self, request: wire.Request, why: str) -> None:
        """The request that `next` returned could not be written."""
        exchange, call = self.channel.exchange, self.channel.call
        if exchange and exchange.request is request:
            self.channel.exchange = None
            if call and call.function.interrupts:
                self.queue.waiting.insert(0, call)
            elif call:
                call.finish(call.without_reply(why))
        self.queue.stop_again()     # what waited in the port is dropped, perhaps a stop, too

    # -- what to do ---------------------------------------------------------------------

    def submit(self, call: Call, now: float) -> None:
        """Queue a call; it gets an outcome whatever happens. A stop is to be sent at once."""
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

    def tick(self, now: float) -> None:
        """End what is over, may not be sent, or waits for too long. Doubt: a move was not answered,
        and may still wait on its way; nobody is told before that is dropped."""
        self._ticked_at = now
        exchange = self.channel.exchange
        if exchange and now >= exchange.deadline:
            self._timed_out(exchange, now)
        self.queue.end(lambda call: self._outcome_of_waiting(call, now))

    def next(self, now: float, has_read_all: bool) -> Optional[wire.Request]:
        """The request to write now, or None. It counts as sent, unless `not_sent` follows.

        Args:
            has_read_all: whether all that was received was taken in; only a stop does not wait.
        """
        channel, call = self.channel, self.queue.urgent()
        if call:
            call.is_urgent, call.refused = False, None
            call.told = unknown('no reply is known to be the one to this')
            return call.request     # it waits for its turn, too
        if not has_read_all or channel.exchange or channel.state is State.CLOSED:
            return None
        if not channel.in_step:
            return self._probe(now)
        call = self.queue.next()
        if call is None:
            channel.state = State.IN_STEP       # the line may stand before a call comes: rule 10
            return None
        needs_fence = call.function.cmd1 == wire.FUNCTION and not (
            call.is_poll and call.request == channel.latest)        # rule 6
        if needs_fence and not channel.is_fenced(now):
            return self._probe(now) if self._options.echo else None
        self.queue.waiting.remove(call)
        call.tries -= 1
        return channel.send(call.request, now, call.timeout, call)

    def _probe(self, now: float) -> wire.Request:
        """Send what has to be answered before the next call; rules 2 and 6."""
        is_echo = self.channel.synchronised and self._options.echo
        return self.channel.send(wire.echo(self._nonce()) if is_echo else wire.SYNC_REQUEST,
                                 now, self._options.reply_timeout)

    def due(self, now: float) -> float:
        """When `tick` and `next` are to be called next, at the latest."""
        channel = self.channel
        times = [call.waits_since + self.queue.longest_wait for call in self.queue.waiting]
        if channel.exchange:
            times.append(channel.exchange.deadline)
        elif now < channel.quiet_until:
            times.append(channel.quiet_until)
        return min(times, default=float('inf'))

    # -- calls --------------------------------------------------------------------------

    def _outcome_of_waiting(self, call: Call, now: float) -> Optional[Outcome]:
        """The outcome of a call that must not be sent, or waits for too long; None if it waits."""
        channel, is_repeatable = self.channel, call.function.repeatable
        if call.refused and not call.tries and channel.in_step:
            return call.refused         # an ECHO has returned since; rule 4
        if call.told and not call.refused and not (is_repeatable and call.tries):
            return call.told
        why = self._refuses(call.function)
        if call.asked <= self._stalled_at and not is_repeatable:
            why = STALLED
        elif call.outcome or now >= call.waits_since + self.queue.longest_wait \
                and not call.is_urgent:
            why = 'the bus is busy, or its line' if channel.in_step else channel.condition.summary
        return call.without_reply(why) if why else None

    def _interrupt(self, why: str, now: float) -> None:
        """A stop is sent now, whatever is outstanding; rule 8."""
        call = self.channel.happened(Event.STOP, now)
        if call:
            self.queue.again(call, now, unknown(why))

    def _data_error(self, call: Call, reply: wire.Reply) -> str:
        """What is wrong with the data of an OK, which is counted; '': nothing; rule 5."""
        if not self._options.echo and reply.data and call.function.reply.is_empty:
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
            code), outcome if is_certain and self._options.echo and not may_be_done else None)

    def _timed_out(self, exchange: Exchange, now: float) -> None:
        """The time for the reply is over; rule 3."""
        self.timeouts += 1
        call = self.channel.happened(Event.TIMEOUT, now, 'no reply')
        if call is None:
            if self.channel.unanswered[exchange.kind] >= TRIES:
                self.queue.end_but_stops(self.channel.condition.summary, now - _PATIENCE)
            self.queue.stop_again()
            return
        self._log.warn('timeout', f'no reply to "{call.request}" within {call.timeout:g} s')
        self.queue.again(call, now, unknown(f'no reply within {call.timeout:g} s'))
        if not call.function.repeatable and not exchange.heard:     # rule 10
            raise Doubt('nothing received since a request, which may still wait')
