"""The link to the control board: sends polls, and requests of callers, who wait for the outcome."""
import os
import threading
from typing import Any, Callable, List, Optional, Sequence, Tuple

from ...framing.stream import IMPLAUSIBLE, LENGTH, Frame
from ...link.connection import PortState
from ...link.link import Link
from ...link.outcome import NOT_SENT, STOPPED, TIMEOUT, Outcome
from ...link.stall import LONGEST_SLEEP
from ...transport.port import Port, PortBusy, PortError
from . import wire
from .announcement import AnnouncementReader
from .call import UNKNOWN, Call, OnSuccess
from .master import STALLED, BusSettings, Hooks, Master
from .polls import Polls
from .session import Condition, Exchange

_NOT_ANNOUNCED = 'the board may have begun anew, and has not announced this function since'
_WRITTEN = 0.3      # s for a stop to be written
_BLOCKED = 0.05     # s until the next try, after the port took no data


class BusLink(Link):
    """Takes requests from any thread. Each gets an outcome, whatever happens to the port.

    Args:
        on_environment: called in the link's thread with each reading and its stamp.
        nonce: returns new bytes for an ECHO.
        link_arguments: frame_timeout, clock, now and logger, as for `Link`.
    """

    HAS_FENCES = True      # the Master drops all replies until its ECHO or SYNC is answered
    DRAINS = True          # no request may be sent before everything received has been read

    def __init__(self, port: Port, settings: BusSettings = BusSettings(),
                 on_environment: Optional[Callable[[wire.Environment, Any], None]] = None,
                 nonce: Callable[[], bytes] = lambda: os.urandom(4), **link_arguments: Any) -> None:
        super().__init__('bus', port, wire.ReplyDecoder(settings.reply_has_cmd2),
                         **link_arguments)
        self.settings = settings
        self.master = Master(settings, self.log, Hooks(
            nonce, self._refuses, self._board_begun_anew, self.port.discard_output))
        self.lending.under_way = self.master.under_way
        self._on_environment: OnSuccess = lambda outcome: on_environment and on_environment(
            wire.Environment.unpack(outcome.data), outcome.stamp)
        self.polls = Polls(self._poll)
        self._reader: Optional[AnnouncementReader] = None
        # Requests of functions that interrupt, which ~stop calls.
        self.stops: List[Tuple[wire.Request, wire.Function]] = []
        self._writing = threading.Lock()    # held from the Master's decision to the write
        if settings.environment_period:
            self.polls.add(wire.ENVIRONMENT_FUNCTION, settings.environment_period,
                           self._on_environment)

    # -- for callers --------------------------------------------------------------------

    def environment(self) -> Tuple[Outcome, Optional[wire.Environment]]:
        """A new reading, or None if the request did not succeed."""
        outcome = self.request(wire.ENVIRONMENT_REQUEST, wire.ENVIRONMENT_FUNCTION,
                               on_success=self._on_environment)
        return outcome, wire.Environment.unpack(outcome.data) if outcome.success else None

    def call(self, function: wire.Function, values: Sequence) -> Outcome:
        """Call a function with these values of its request's layout, and wait for the outcome."""
        try:
            request = function.make_request(values)
        except ValueError as error:
            return Outcome(NOT_SENT, f'{error}; nothing was sent')
        return self.request(request, function)

    def request(self, request: wire.Request, function: wire.Function = wire.RAW,
                on_success: Optional[OnSuccess] = None) -> Outcome:
        """Send any request and wait for its outcome, which always comes: see `submit`."""
        call = self.submit(request, function, on_success)
        turns = call.tries * (self.master.queue.longest_wait + call.timeout)
        if not call.over.wait(turns):       # then the Master drops it
            call.finish(Outcome(TIMEOUT, f'the bridge is stuck: {UNKNOWN}'))
        assert call.outcome
        return call.outcome

    def submit(self, request: wire.Request, function: wire.Function = wire.RAW,
               on_success: Optional[OnSuccess] = None) -> Call:
        """Have a request sent, and return the call, which gets its outcome; `on_success` is called
        in the link's thread."""
        size, refusal = len(request.data), ''
        if size > wire.MAX_LENGTH:
            refusal = f'data is {size} bytes long, may be at most {wire.MAX_LENGTH}'
        elif not self.port.is_open:
            refusal = f'the port {self.port.url} is closed ({self.connection.trouble})'
        elif not function.repeatable and self.connection.may_be_from_a_stall():
            refusal = STALLED
        call = self.master.submit(request, function, self.now(), on_success, refusal=refusal)
        self.wake()
        return call

    def stop_motion(self) -> str:
        """Send all requests that interrupt; without any, a move that is under way goes on."""
        with self._writing:         # from now on the link's thread sees `is_stopped`
            moving = '' if self.stops else self.master.under_way()
        calls = [self.master.submit(*stop, self.now()) for stop in self.stops]
        self.wake()
        deadline = self.now() + _WRITTEN
        missing = [call for call in calls
                   if not call.written.wait(max(0.0, deadline - self.now()))]
        return '; '.join(filter(None, [moving, *(
            f'{call.request}: {call.outcome.message if call.outcome else "not written in time"}'
            for call in missing)]))

    # -- for the Master -----------------------------------------------------------------

    def _refuses(self, function: wire.Function) -> str:
        """Why a function is not sent now; '': it is."""
        if self.is_stopped and not function.repeatable:
            return STOPPED
        is_missing = function.announced and not self.announcement.is_current    # rule 12
        return _NOT_ANNOUNCED if is_missing else ''

    def _board_begun_anew(self, now: float) -> None:
        self.announcement.reset()
        if self._reader:
            self._reader.begin(now)

    def _poll(self, request: wire.Request, function: wire.Function,
              on_success: Optional[OnSuccess] = None) -> Call:
        return self.master.submit(request, function, self.now(), on_success, is_poll=True)

    # -- hooks --------------------------------------------------------------------------

    def opened(self, now: float) -> None:
        self.polls.start(now)
        if self.settings.announcements:
            self._reader = AnnouncementReader(lambda index: self._poll(
                wire.ANNOUNCEMENT.make_request((index,)), wire.ANNOUNCEMENT),
                self.announcement.assembly, self.log)
        self.master.session.begin()

    def closed(self, now: float) -> None:
        self.master.end(self.connection.trouble, now)

    def idle(self, now: float) -> Optional[float]:
        self.master.tick(now)
        return None

    def received(self, frame: Frame, now: float) -> None:
        self.master.received(frame, now)

    def shown(self, frame: Frame) -> Frame:
        call = self.master.session.call
        if frame.cause or call is None:
            return frame
        return frame._replace(message=call.function.name_reply(frame.message))

    def damaged(self, frame: Frame, now: float) -> None:
        self.master.damaged(frame, now)

    def stalled(self, seconds: float, now: float) -> None:
        self.master.stalled(now)

    def altered(self, now: float) -> None:
        self.master.doubt('another program changed the settings of the port', now)

    def tick(self, now: float) -> Optional[float]:
        master, due = self.master, now + LONGEST_SLEEP
        if master.session.synchronised:
            due = min(due, self.polls.tick(now, self.announcement.is_current))
            text = self._reader.tick(now) if self._reader else None
            if text is not None and self.announcement.on_text:
                self.announcement.on_text(text)
        master.session.heard(self.connection.last_byte_at)
        has_read_all = self.connection.state is PortState.DRAINED and not self.decoder.begun
        with self._writing:
            master.tick(now)
            exchange = master.next(now, has_read_all)
            if exchange:
                return self._write(exchange, now)
        return min(due, master.due(now))

    def _write(self, exchange: Exchange, now: float) -> float:
        """Write a request; return when to look for the next one."""
        request, call = exchange.request, exchange.call
        frame = wire.encode_request(request, self.settings.environment_datelen)
        is_old = self.connection.stalls.stalled_for(self.now())     # since `next`
        if is_old and call and not call.function.repeatable:
            self.master.not_sent(exchange, STALLED)
            return now
        try:
            self.send(frame, request.cmd1, request.cmd2, request.data, request)
        except PortBusy as error:
            self.log.warn('busy', f'{error}; the output that waited is dropped; '
                          'does flow control block the port?')
            self.port.discard_output()
            self.master.not_sent(exchange, str(error))
            return now + _BLOCKED
        except PortError:
            self.master.not_sent(exchange, 'the port closed')
            raise
        if call:
            call.written.set()
        return now

    # -- diagnostics --------------------------------------------------------------------

    def condition(self, now: float) -> Tuple[int, str]:
        if not self.port.is_open:
            return super().condition(now)
        condition = self.master.session.condition
        unknown = self.presence.meaning(now) if condition is Condition.NO_SYNC else ''
        return condition.level, unknown or condition.text

    def condition_of_board(self, now: float) -> str:
        return self.master.session.condition.word

    def talks(self, now: float) -> Optional[bool]:
        # None for NO_ECHO: the board answers SYNC, and the session has logged the rest.
        return {Condition.READY: True, Condition.NO_SYNC: False}.get(
            self.master.session.condition)

    def silence(self) -> str:
        return (f'{self.master.session.condition.text}; SYNC is repeated; check its power, its '
                f'wiring and the baud rate ({self.port.baud})')

    def error_count(self) -> int:
        return super().error_count() + self.master.timeouts + sum(self.master.data_errors.values())

    def extra_values(self) -> List[Tuple[str, Any]]:
        times = sorted(self.master.round_trips)
        return [('timeouts', self.master.timeouts),
                ('length errors', self.master.data_errors[LENGTH]),
                ('implausible errors', self.master.data_errors[IMPLAUSIBLE]),
                ('round trip p50 [ms]', f'{times[len(times) // 2] * 1e3:.2f}' if times else '-'),
                ('round trip max [ms]', f'{times[-1] * 1e3:.2f}' if times else '-')]
