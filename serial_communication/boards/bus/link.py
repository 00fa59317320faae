"""The link to the control board: sends polls, and requests of callers, who wait for the outcome."""
import logging
import os
from typing import Any, Callable, List, NamedTuple, Optional, Sequence, Tuple

from ...framing.stream import IMPLAUSIBLE, LENGTH, Frame
from ...link.link import Link
from ...link.outcome import NOT_SENT, STOPPED, Outcome
from ...link.session import ERROR, OK, WARN, Condition, Doubt, Packet, Refused, Session
from ...link.sparing_log import SparingLog
from ...transport.pace import clock
from ...transport.port import Port
from . import wire
from .announcement import AnnouncementReader
from .call import NOT_READY_WAIT, Call
from .master import Master
from .polls import Polls
from .session import Condition as State

# Of the conditions in which the board is synchronised, for programs.
_WORDS = {State.READY: 'ok', State.OUT_OF_STEP: 'out_of_step', State.NO_ECHO: 'no_echo'}
_LONGEST_SLEEP = 0.1
_LONGEST_WAIT = 0.3     # s that the link may wait for input before that is shown


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


class MasterSession(Session):
    """The Master's session as a link drives it.

    Args:
        nonce: returns new bytes for an ECHO.
    """

    NAME = 'bus'
    FENCED = True      # the Master drops all replies until its ECHO or SYNC is answered

    def __init__(self, log: SparingLog, settings: BusSettings, nonce: Callable[[], bytes],
                 on_environment: Callable[[wire.Environment, Any], None],
                 now: Callable[[], float]) -> None:
        super().__init__(wire.ReplyDecoder(settings.reply_has_cmd2), log)
        self.settings = settings
        self.now = now
        self._doubt = ''
        self.master = Master(settings.reply_timeout, settings.motion_timeout, self.log, nonce,
                             drop_output=self._drop_output, begun_anew=self._board_begun_anew,
                             still_announces=lambda: self.announcement.is_current,
                             is_stopped=lambda: self.is_stopped, echoes=settings.echo)
        self.on_environment = lambda outcome: on_environment(
            wire.Environment.unpack(outcome.data), outcome.stamp)
        self.polls = Polls(lambda request, function, on_success: self.master.submit(
            self.make(request, function, on_success, poll=True)))
        self._reader = AnnouncementReader(
            lambda index: self.master.submit(self.make(
                wire.ANNOUNCEMENT.make_request((index,)), wire.ANNOUNCEMENT, poll=True)),
            self.announcement.assembly, self.log) if settings.announcements else None
        # Requests of functions that interrupt, which ~stop calls.
        self.stops: List[Tuple[wire.Request, wire.Function]] = []
        self._waits_since = 0.0     # when a request could be sent last; monotonic
        if settings.environment_period:
            self.polls.add(wire.ENVIRONMENT_FUNCTION, settings.environment_period,
                           self.on_environment)

    def make(self, request: wire.Request, function: wire.Function,
             on_success: Optional[Callable[[Outcome], None]] = None, poll: bool = False) -> Call:
        """A call of a function by this request."""
        moves = wire.built_in(request, function).moves      # a raw request may be one, too
        timeout = function.timeout or (
            self.settings.motion_timeout if moves else self.settings.reply_timeout)
        return Call(request, function, timeout, 1 + self.settings.retries, self.now(), poll,
                    on_success)

    def _drop_output(self, sent: float) -> None:
        if self.presence.byte_at <= sent:
            self._doubt = 'nothing received since a request, which may still wait'

    def _board_begun_anew(self, now: float) -> None:
        self.announcement.reset()
        if self._reader:
            self._reader.restart(now)

    # -- what happens -------------------------------------------------------------------

    def begin(self, now: float, is_opening: bool) -> None:
        if not is_opening:
            self.master.stalled(now)
            return
        self.polls.start(now)
        if self._reader:
            self._reader.opened()
        self.master.connected(now)
        self._waits_since = now

    def end(self, why: str, now: float) -> None:
        self.master.disconnected(now, why)

    def idle(self, now: float) -> Optional[float]:
        return self.master.step(now, port_ready=False)[1]

    def received(self, frame: Frame, now: float) -> None:
        with self.lock:
            self.master.received(frame, now)

    def shown(self, frame: Frame) -> Frame:
        call = self.master.outstanding_call
        if frame.cause or call is None:
            return frame
        return frame._replace(message=call.function.name_reply(frame.message))

    def damaged(self, frame: Frame, now: float) -> None:
        with self.lock:
            self.master.damaged(frame, now)

    def under_way(self, is_reset: bool = False) -> str:
        return self.master.under_way()

    # -- what to do ---------------------------------------------------------------------

    def may_be_old(self, request: Any) -> bool:
        if isinstance(request, Call):
            return request.function.repeatable
        call = self.master.outstanding_call
        return call is None or call.function.repeatable or call.request is not request

    def submit(self, request: Call, now: float) -> List[Packet]:
        if self.is_stopped and not request.function.repeatable:
            raise Refused(STOPPED, 'stopped')
        self.master.submit(request)
        self.wake()
        return self._at_once(now) if request.function.interrupts else []

    def stop(self, now: float, why: str = '') -> Tuple[List[Packet], str]:
        if why:
            return [], ''
        moving = '' if self.stops else self.master.under_way()
        for stop in self.stops:
            self.master.submit(self.make(*stop))
        return self._at_once(now), moving

    def _at_once(self, now: float) -> List[Packet]:
        """The requests that interrupt."""
        packets: List[Packet] = []
        while True:
            request, _ = self.master.step(now, 'the end of a call that interrupts')
            if request is None:
                return packets
            packets.append(self._packet(request))

    def due(self, now: float, is_drained: bool) -> Tuple[List[Packet], Optional[float]]:
        due = now + _LONGEST_SLEEP
        if self.master.synchronised:
            due = min(due, self.polls.tick(now, self.announcement.is_current))
            text = self._reader.step(now) if self._reader else None
            if text is not None and self.announcement.on_text:
                self.announcement.on_text(text)
        waits_for = 'the end of the bytes that are received' if not is_drained else \
            'the rest of an incomplete frame' if self.decoder.begun else ''
        if not waits_for:
            self._waits_since = now
        self.master.bytes_came(self.presence.byte_at)
        request, wake_at = self.master.step(now, waits_for)
        if self._doubt:
            why, self._doubt = self._doubt, ''
            raise Doubt(why)
        return [] if request is None else [self._packet(request)], \
            due if wake_at is None else min(due, wake_at)

    def _packet(self, request: wire.Request) -> Packet:
        return Packet(wire.encode_request(request, self.settings.environment_datelen),
                      request.cmd1, request.cmd2, request.data, request)

    def sent(self, packet: Packet, now: float) -> None:
        self.master.sent(packet.message)

    def not_sent(self, packet: Packet, why: str) -> None:
        self.master.not_sent(why)

    # -- what it looks like ---------------------------------------------------------------

    def condition(self, now: float) -> Condition:
        state = self.master.condition()
        if state is State.READY:
            waits = now - self._waits_since > _LONGEST_WAIT
            return Condition(WARN, 'ok', 'open, waits for the end of what is received') if waits \
                else Condition(OK, 'ok', 'ready')
        level = ERROR if state in (State.NO_SYNC, State.NO_ECHO) else WARN
        unknown = self.presence.no_frame(now) if state is State.NO_SYNC else ''
        return Condition(level, _WORDS.get(state, 'not_synchronised'), unknown or state.value)

    def talks(self, now: float) -> Optional[bool]:
        # None for NO_ECHO: the board answers SYNC, and the Master has logged the rest.
        return {State.READY: True, State.NO_SYNC: False}.get(self.master.condition())

    def silence(self) -> str:
        return f'{self.master.condition().value}; SYNC is repeated'

    def error_count(self) -> int:
        return self.master.timeouts + sum(self.master.data_errors.values())

    def values(self) -> List[Tuple[str, Any]]:
        times = sorted(self.master.round_trips)
        return [('timeouts', self.master.timeouts),
                ('length errors', self.master.data_errors[LENGTH]),
                ('implausible errors', self.master.data_errors[IMPLAUSIBLE]),
                ('round trip p50 [ms]', f'{times[len(times) // 2] * 1e3:.2f}' if times else '-'),
                ('round trip max [ms]', f'{times[-1] * 1e3:.2f}' if times else '-')]


class BusLink(Link):
    """Takes requests from any thread. Each gets an outcome, whatever happens to the port.

    Args:
        on_environment: called in the link's thread with each reading and its stamp.
        nonce: returns new bytes for an ECHO.
        link_arguments: those of `Link`.
    """

    session: MasterSession

    def __init__(self, port: Port, settings: BusSettings = BusSettings(),
                 on_environment: Callable[[wire.Environment, Any], None] = lambda *_: None,
                 nonce: Callable[[], bytes] = lambda: os.urandom(4),
                 logger: Optional[logging.Logger] = None, now: Callable[[], float] = clock,
                 **link_arguments: Any) -> None:
        log = SparingLog('bus', logger or logging.getLogger(__name__), clock=now)
        super().__init__(port, MasterSession(log, settings, nonce, on_environment, now), now=now,
                         **link_arguments)
        self.settings = settings

    # -- for callers --------------------------------------------------------------------

    def lift(self, direction: int, distance: int) -> Outcome:
        """Move the lift by `distance` (0 … 255 mm); direction 0 is up, 1 is down."""
        return self.call(wire.LIFT_FUNCTION, (direction, distance))

    def gimbal(self, direction: int, angle: int) -> Outcome:
        """Turn the gimbal by `angle` (0 … 255 degrees); 0 left, 1 right, 2 up, 3 down."""
        return self.call(wire.GIMBAL_FUNCTION, (direction, angle))

    def environment(self) -> Tuple[Outcome, Optional[wire.Environment]]:
        """A new reading, or None if the request did not succeed."""
        outcome = self.request(wire.ENVIRONMENT_REQUEST, wire.ENVIRONMENT_FUNCTION,
                               on_success=self.session.on_environment)
        return outcome, wire.Environment.unpack(outcome.data) if outcome.success else None

    def call(self, function: wire.Function, values: Sequence) -> Outcome:
        """Call a function with these values of its request's layout, and wait for the outcome."""
        try:
            request = function.make_request(values)
        except ValueError as error:
            return Outcome(NOT_SENT, f'{error}; nothing was sent')
        return self.request(request, function)

    def request(self, request: wire.Request, function: wire.Function = wire.RAW,
                on_success: Optional[Callable[[Outcome], None]] = None) -> Outcome:
        """Send any request and wait for its outcome: see `submit`.

        Returns after the timeouts of all its tries at the latest, plus the time that it waits for
        its turn, which is at most `motion_timeout`, or 0.8 s if that is longer.
        """
        call = self.submit(request, function, on_success)
        return call.wait(max(self.settings.motion_timeout, NOT_READY_WAIT)
                         + call.tries * (call.timeout + NOT_READY_WAIT))

    def submit(self, request: wire.Request, function: wire.Function = wire.RAW,
               on_success: Optional[Callable[[Outcome], None]] = None) -> Call:
        """Have a request sent, and return the call, which gets its outcome.

        What may have waited while the bridge stalled is not sent, unless it is repeatable.

        Args:
            function: what it calls.
            on_success: called in the link's thread with a successful outcome.
        """
        call = self.session.make(request, function, on_success)
        size = len(call.request.data)
        try:
            if size > wire.MAX_LENGTH:
                raise Refused(f'data is {size} bytes long, may be at most {wire.MAX_LENGTH}',
                              'value')
            self.writer.submit(call)
        except Refused as refused:
            call.finish(Outcome(NOT_SENT, f'{refused}; nothing was sent'))
        return call
