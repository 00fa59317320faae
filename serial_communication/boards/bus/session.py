"""The Master on a robot-ctrl-bus: which request is sent when, and what a reply means to its call.

channel.py has the states and transitions, call.py the calls. Comments refer to the rules of the bus
chapter of doc/protocols.md by their numbers.
"""
import os
from collections import deque
from typing import Any, Callable, Deque, List, Optional, Tuple

from ...framing.stream import CHECKSUM, IMPLAUSIBLE, LENGTH, Frame
from ...link.freshness import stall
from ...link.outcome import NOT_ANNOUNCED, STOPPED, Outcome
from ...link.session import Condition, Doubt, Packet, Session
from ...link.sparing_log import SparingLog
from ...link.writer import STALLED
from . import wire
from .call import Call, MasterOptions, OnSuccess, Queue, outcome_of, unknown
from .channel import NO_SYNC, READY, TRIES, Channel, Event, Exchange, Kind, State
from .polls import AnnouncementReader, Polls

_PATIENCE = 0.8     # s that a call waits for a board that does not answer


class MasterSession(Session):
    """Each call gets an outcome, whatever happens to the port.

    Args:
        nonce: returns new bytes for an ECHO.
    """

    NAME = 'bus'
    FENCED = True      # all replies are dropped until its ECHO or SYNC is answered

    def __init__(self, log: SparingLog, options: MasterOptions = MasterOptions(),
                 nonce: Callable[[], bytes] = lambda: os.urandom(4)) -> None:
        super().__init__(wire.ReplyDecoder(options.reply_has_cmd2), log)
        self.errors.update({LENGTH: 0, IMPLAUSIBLE: 0})     # of the data in an OK
        self.options = options
        self.channel = Channel(options.echo, options.reply_timeout, nonce, log)
        self.queue = Queue(max(options.motion_timeout, TRIES * options.reply_timeout))
        self.polls = Polls(self._ask)
        # Requests of functions that interrupt, which ~stop calls.
        self.stops: List[Tuple[wire.Request, wire.Function]] = []
        self._reader: Optional[AnnouncementReader] = None
        self._round_trips: Deque[float] = deque(maxlen=200)     # s; the latest
        self._looked_at = self._stalled_at = float('-inf')      # the end of the latest stall

    # -- what happens -------------------------------------------------------------------

    def begin(self, now: float, is_opening: bool) -> None:
        """On a port that stays open, replies may have been missed and requests lost. If that is so
        because the bridge did not run, what moves and was asked for until now is too old; rule 9.
        """
        if is_opening:
            self.polls.start(now)
            if self.options.announcements:
                self._reader = AnnouncementReader(self._ask, self.announcement.assembly, self.log)
            self.channel.begin()
            self._looked_at = now
            return
        if stall(now - self._looked_at):
            self._stalled_at = now
        self.channel.happened(Event.OTHER, now, 'the link begins anew')
        self.queue.doubt_refusals()
        call = self.channel.call
        if call and call.function.interrupts:
            self._ended(Event.STOP, now, 'it was sent again before the reply')
        self.queue.stop_again()

    def end(self, why: str, now: float) -> None:
        """Every call has an outcome now."""
        call = self.channel.happened(Event.CLOSED, now)
        if call:
            call.finish(unknown(f'the port closed before the reply arrived ({why})'))
        self.queue.end(lambda call: call.without_reply(f'the port is closed ({why})'))

    def damaged(self, frame: Frame, now: float) -> None:
        with self.lock:
            self.queue.doubt_refusals()
            # Only a frame with a wrong checksum can be the reply. After noise, for example during a
            # motion, the reply may still arrive.
            self._ended(Event.FAILED if frame.cause == CHECKSUM else Event.OTHER, now,
                        'received bytes that are no valid reply')

    def received(self, frame: Frame, now: float) -> None:
        with self.lock:
            reply, channel = frame.message, self.channel
            exchange, call, in_step = channel.exchange, channel.call, channel.in_step
            event, cause, error = channel.event_of(reply), '', ''
            if reply.cmd1 == wire.OK:
                self.queue.doubt_refusals()
                if call and event is Event.ANSWER:
                    cause, error = call.data_error(reply, self.options.echo)
            if cause:
                self.errors[cause] += 1
                self.log.warn('unexpected', error)
            if error:       # without ECHO the right reply may follow
                event = Event.FAILED if self.options.echo else Event.OTHER
            if event is Event.LOST and channel.unanswered[Kind.ECHO] >= TRIES:
                event = Event.OTHER     # SYNC and ECHO do not alternate faster than ECHOs time out
            if event is Event.LOST or event is Event.ANSWER and reply.cmd1 == wire.SYNC:
                self.announcement.assembly.reset()     # rule 12
                if self._reader:
                    self._reader.begin(now)
            call = channel.happened(event, now, f'received {reply}, no reply to '
                                    f'{exchange.request if exchange else "a request"}')
            if call and exchange:
                outcome = outcome_of(reply, exchange.request, now - exchange.sent, frame.stamp)
                if error:
                    outcome = outcome._replace(message=error, as_expected=False)
                self._round_trips.append(outcome.round_trip)
                self.queue.answered(call, outcome, now, in_step and self.options.echo)

    def not_sent(self, packet: Packet, why: str) -> None:
        exchange, call = self.channel.exchange, self.channel.call
        if exchange and exchange.request is packet.message:
            self.channel.exchange = None
            if call and call.function.interrupts:
                self.queue.waiting.insert(0, call)
            elif call:
                call.finish(call.without_reply(why))
        self.queue.stop_again()     # what waited in the port is dropped, perhaps a stop, too

    # -- what to do ---------------------------------------------------------------------

    def may_be_old(self, request: Any) -> bool:
        call = request if isinstance(request, Call) else self.channel.call
        return call is None or call.function.repeatable

    def submit(self, request: Call, now: float) -> List[Packet]:
        """Queue a call; a stop is to be sent at once."""
        outcome = self._outcome_of_waiting(request, now)
        if outcome:
            request.finish(outcome)        # what is not sent interrupts nothing
            return []
        if request.function.interrupts:
            self._ended(Event.STOP, now, f'{request.request} was sent before the reply')
            self.queue.end_but_stops(f'{request.request} was called', now)
            request.is_urgent = True
        request.waits_since = request.asked
        self.queue.waiting.append(request)
        if not request.is_poll:
            self.wake()
        return [] if request.is_poll else self._packets(now, False)

    def _ask(self, request: wire.Request, function: wire.Function, now: float,
             on_success: Optional[OnSuccess]) -> Call:
        """Submit a poll, which is sent in `due`."""
        call = self.options.call(request, function, now, on_success, is_poll=True)
        self.submit(call, now)
        return call

    def stop(self, now: float, why: str = '') -> Tuple[List[Packet], str]:
        moving, packets = '' if self.stops else self.under_way(), self._packets(now, False)
        for request, function in () if why else self.stops:
            packets += self.submit(self.options.call(request, function, now), now)
        return packets, moving

    def due(self, now: float, is_drained: bool) -> Tuple[List[Packet], Optional[float]]:
        channel, due, self._looked_at = self.channel, now + 1.0, now
        if channel.synchronised:
            due = self.polls.tick(now, self.announcement.is_current)
            text = self._reader.tick(now) if self._reader else None
            if text is not None and self.announcement.on_text:
                self.announcement.on_text(text)
        channel.heard(self.presence.byte_at)
        if channel.exchange and now >= channel.exchange.deadline:
            self._timed_out(channel.exchange, now)
        self.queue.end(lambda call: self._outcome_of_waiting(call, now))
        packets = self._packets(now, is_drained and not self.decoder.begun)
        return packets, min(due, channel.due(now), self.queue.due())

    def _packets(self, now: float, has_read_all: bool) -> List[Packet]:
        """What is to be written now. It counts as sent, unless `not_sent` follows.

        Args:
            has_read_all: whether all that was received was taken in; only a stop does not wait.
        """
        channel, requests = self.channel, []
        for call in self.queue.urgent():        # each waits for its turn, too
            call.is_urgent, call.refused = False, None
            call.told = unknown('no reply is known to be the one to this')
            requests.append(call.request)
        if has_read_all and not channel.exchange and channel.state is not State.CLOSED:
            next_call = self.queue.next()
            if channel.in_step and next_call is None:
                channel.state = State.IN_STEP   # the line may stand before a call comes: rule 10
            elif next_call and channel.may_send(next_call, now):
                self.queue.waiting.remove(next_call)
                next_call.tries -= 1
                requests.append(channel.send(next_call.request, now, next_call.timeout, next_call))
            elif not channel.in_step or self.options.echo:
                requests.append(channel.probe(now))
        return [Packet(wire.encode_request(each, self.options.environment_datelen), each.cmd1,
                       each.cmd2, each.data, each) for each in requests]

    def _outcome_of_waiting(self, call: Call, now: float) -> Optional[Outcome]:
        """The outcome of a call that must not be sent, or waits for too long; None if it waits."""
        channel, function, why = self.channel, call.function, ''
        if call.refused and not call.tries and channel.in_step:
            return call.refused         # an ECHO has returned since; rule 4
        if call.told and not call.refused and not (function.repeatable and call.tries):
            return call.told
        if call.asked <= self._stalled_at and not function.repeatable:
            why = STALLED
        elif call.outcome or now >= call.waits_since + self.queue.longest_wait \
                and not call.is_urgent:
            why = 'the bus is busy, or its line' if channel.in_step else channel.condition.summary
        elif self.is_stopped and not function.repeatable:
            why = STOPPED
        elif function.announced and not self.announcement.is_current:
            why = NOT_ANNOUNCED        # rule 12
        return call.without_reply(why) if why else None

    def _ended(self, event: Event, now: float, why: str) -> Optional[Call]:
        """An event ends the try of the call that is returned, without a reply; or of none."""
        call = self.channel.happened(event, now, why)
        if call:
            self.queue.again(call, now, unknown(why))
        return call

    def _timed_out(self, exchange: Exchange, now: float) -> None:
        """The time for the reply is over; rule 3. Doubt: a move was not answered, and may still
        wait on its way; nobody is told before that is dropped."""
        self.timeouts += 1
        why = f'no reply within {exchange.deadline - exchange.sent:g} s'
        call = self._ended(Event.TIMEOUT, now, why)
        if call:
            self.log.warn('timeout', f'"{call.request}": {why}')
            if not call.function.repeatable and not exchange.heard:     # rule 10
                raise Doubt('nothing received since a request, which may still wait')
        else:
            if self.channel.unanswered[exchange.kind] >= TRIES:
                self.queue.end_but_stops(self.channel.condition.summary, now - _PATIENCE)
            self.queue.stop_again()

    def under_way(self, is_reset: bool = False) -> str:
        call = self.channel.call
        return '' if call is None or call.function.repeatable else f'"{call.request}" is under way'

    # -- what it looks like ---------------------------------------------------------------

    def condition(self, now: float) -> Condition:
        condition = self.channel.condition
        unknown_frames = self.presence.no_frame(now) if condition is NO_SYNC else ''
        return condition._replace(summary=unknown_frames or condition.summary)

    def talks(self, now: float) -> Optional[bool]:
        # None: the board answers, perhaps SYNC alone, which the channel logs.
        condition = self.channel.condition
        return True if condition is READY else False if condition is NO_SYNC else None

    def shown(self, frame: Frame) -> Frame:
        call = self.channel.call
        if frame.cause or call is None:
            return frame
        return frame._replace(message=call.function.name_reply(frame.message))

    def values(self) -> List[Tuple[str, Any]]:
        times = sorted(self._round_trips)
        return [('timeouts', self.timeouts),
                ('round trip p50 [ms]', f'{times[len(times) // 2] * 1e3:.2f}' if times else '-'),
                ('round trip max [ms]', f'{times[-1] * 1e3:.2f}' if times else '-')]
