"""The link to the control board: sends polls, and requests of callers, who wait for the outcome."""
import os
import threading
from typing import Any, Callable, List, NamedTuple, Optional, Sequence, Tuple

from ...framing.stream import IMPLAUSIBLE, LENGTH, Frame
from ...link.connection import PortState
from ...link.link import ERROR, OK, WARN, Link
from ...link.outcome import NOT_SENT, STOPPED, Outcome
from ...link.stall import LONGEST_SLEEP, STALL
from ...transport.port import Port, PortBusy, PortError
from . import wire
from .announcement import AnnouncementReader
from .call import NOT_READY_WAIT, Call
from .master import STALLED, Master
from .polls import Polls
from .session import Condition

# Of the conditions in which the board is synchronised, for programs.
_WORDS = {Condition.READY: 'ok', Condition.OUT_OF_STEP: 'out_of_step',
          Condition.NO_ECHO: 'no_echo'}
_WRITTEN = 0.3      # s for a stop to be written
_BLOCKED = 0.05     # s until the next try, after the port took no data


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
        self.master = Master(settings.reply_timeout, settings.motion_timeout, self.log, nonce,
                             drop_output=self._drop_output, begun_anew=self._board_begun_anew,
                             still_announces=lambda: self.announcement.is_current,
                             is_stopped=lambda: self.is_stopped, echoes=settings.echo)
        self.lending.under_way = self.master.under_way
        self._on_environment = lambda outcome: on_environment and on_environment(
            wire.Environment.unpack(outcome.data), outcome.stamp)
        self.polls = Polls(lambda request, function, on_success: self.master.submit(
            self._call(request, function, on_success, poll=True)))
        self._reader = AnnouncementReader(
            lambda index: self.master.submit(self._call(
                wire.ANNOUNCEMENT.make_request((index,)), wire.ANNOUNCEMENT, poll=True)),
            self.announcement.assembly, self.log) if settings.announcements else None
        # Requests of functions that interrupt, which ~stop calls.
        self.stops: List[Tuple[wire.Request, wire.Function]] = []
        self._stepping = threading.Lock()   # held from the Master's decision to the write
        self._blocked_until = 0.0
        self._waits_since = 0.0     # when a request could be sent last; monotonic
        if settings.environment_period:
            self.polls.add(wire.ENVIRONMENT_FUNCTION, settings.environment_period,
                           self._on_environment)

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
        call = self._call(request, function, on_success)
        # Also after the time of the call was taken: the Master refuses it if a stall follows.
        why = self._why_not(call)
        if why:
            call.finish(Outcome(NOT_SENT, f'{why}; nothing was sent'))
        else:
            self.master.submit(call)
            self.wake()
        return call

    def _why_not(self, call: Call) -> str:
        size = len(call.request.data)
        if size > wire.MAX_LENGTH:
            return f'data is {size} bytes long, may be at most {wire.MAX_LENGTH}'
        if self.is_stopped and not call.function.repeatable:
            return STOPPED
        if not self.port.is_open:
            return f'the port {self.port.url} is closed ({self.connection.trouble})'
        if not call.function.repeatable and self.connection.may_be_from_a_stall():
            return STALLED
        return ''

    def stop_motion(self) -> str:
        """Send all requests that interrupt; without any, a move that is under way goes on."""
        with self._stepping:        # from now on the link's thread sees `is_stopped`
            moving = '' if self.stops else self.master.under_way()
        calls = [self.master.submit(self._call(*stop)) for stop in self.stops]
        self.wake()
        deadline = self.now() + _WRITTEN
        for call in calls:
            call.written.wait(max(0.0, deadline - self.now()))
        return '; '.join(filter(None, [moving, *map(_not_written, calls)]))

    def _call(self, request: wire.Request, function: wire.Function,
              on_success: Optional[Callable[[Outcome], None]] = None, poll: bool = False) -> Call:
        moves = wire.built_in(request, function).moves      # a raw request may be one, too
        timeout = function.timeout or (
            self.settings.motion_timeout if moves else self.settings.reply_timeout)
        return Call(request, function, timeout, 1 + self.settings.retries, self.now(), poll,
                    on_success)

    def _drop_output(self, sent: float) -> None:
        if self.connection.last_byte_at <= sent:
            self.port.discard_output('nothing received since a request, which may still wait')

    def _board_begun_anew(self, now: float) -> None:
        self.announcement.reset()
        if self._reader:
            self._reader.restart(now)

    # -- hooks --------------------------------------------------------------------------

    def opened(self, now: float) -> None:
        self.polls.start(now)
        if self._reader:
            self._reader.opened()
        self.master.connected(now)
        self._waits_since = now

    def closed(self, now: float) -> None:
        self.master.disconnected(now, self.connection.trouble)

    def idle(self, now: float) -> Optional[float]:
        return self.master.step(now, port_ready=False)[1]

    def received(self, frame: Frame, now: float) -> None:
        self.master.received(frame, now)

    def shown(self, frame: Frame) -> Frame:
        call = self.master.outstanding_call
        if frame.cause or call is None:
            return frame
        return frame._replace(message=call.function.name_reply(frame.message))

    def damaged(self, frame: Frame, now: float) -> None:
        self.master.damaged(frame, now)

    def stalled(self, seconds: float, now: float) -> None:
        self.master.stalled(now)

    def altered(self, now: float) -> None:
        self.master.may_have_missed('another program changed the settings of the port', now)

    def tick(self, now: float) -> Optional[float]:
        due = now + LONGEST_SLEEP
        if self.master.synchronised:
            due = min(due, self.polls.tick(now, self.announcement.is_current))
            text = self._reader.step(now) if self._reader else None
            if text is not None and self.announcement.on_text:
                self.announcement.on_text(text)
        waits_for = self._waits_for()
        if not waits_for:
            self._waits_since = now
        self.master.bytes_came(self.connection.last_byte_at)
        with self._stepping:
            request, wake_at = self.master.step(now, waits_for, now >= self._blocked_until)
            if request is not None:
                self._send_request(request, now)
        if now < self._blocked_until:
            due = min(due, self._blocked_until)
        return due if wake_at is None else min(due, wake_at)

    def _waits_for(self) -> str:
        """What has to be received and decoded before a request may be sent; '': nothing."""
        state = self.connection.state
        if state is PortState.DROPPING:
            return 'the end of the bytes that waited during a stall'
        if self.decoder.begun:
            return 'the rest of an incomplete frame'
        return '' if state is PortState.DRAINED else 'the end of the bytes that are received'

    def _send_request(self, request: wire.Request, now: float) -> None:
        frame = wire.encode_request(request, self.settings.environment_datelen)
        call = self.master.outstanding_call
        if call and not call.function.repeatable and self.connection.stalls.stalled_for(
                self.now()):      # since `step` decided that it may be sent
            self.master.not_sent(STALLED)
            return
        try:
            self.send(frame, request.cmd1, request.cmd2, request.data, request)
            self.master.sent(request)
        except PortBusy as error:
            self.log.warn('busy', f'{error}; the output that waited is dropped; '
                          'does flow control block the port?')
            self.port.discard_output()
            self.master.not_sent(str(error))
            self._blocked_until = now + _BLOCKED
        except PortError:
            self.master.not_sent('the port closed')
            raise

    # -- diagnostics --------------------------------------------------------------------

    def condition(self, now: float) -> Tuple[int, str]:
        if not self.port.is_open:
            return super().condition(now)
        condition = self.master.condition()
        if condition is Condition.READY:
            waits_for = self._waits_for()
            if waits_for and now - self._waits_since > STALL:
                return WARN, f'open, waits for {waits_for}'
            return OK, 'ready'
        level = ERROR if condition in (Condition.NO_SYNC, Condition.NO_ECHO) else WARN
        unknown = self.presence.meaning(now) if condition is Condition.NO_SYNC else ''
        return level, unknown or condition.value

    def condition_of_board(self, now: float) -> str:
        return _WORDS.get(self.master.condition(), 'not_synchronised')

    def talks(self, now: float) -> Optional[bool]:
        # None for NO_ECHO: the board answers SYNC, and the Master has logged the rest.
        return {Condition.READY: True, Condition.NO_SYNC: False}.get(self.master.condition())

    def silence(self) -> str:
        return (f'{self.master.condition().value}; SYNC is repeated; check its power, its wiring '
                f'and the baud rate ({self.port.baud})')

    def error_count(self) -> int:
        master = self.master
        return super().error_count() + master.timeouts + sum(master.data_errors.values())

    def extra_values(self) -> List[Tuple[str, Any]]:
        times = sorted(self.master.round_trips)
        return [('timeouts', self.master.timeouts),
                ('length errors', self.master.data_errors[LENGTH]),
                ('implausible errors', self.master.data_errors[IMPLAUSIBLE]),
                ('round trip p50 [ms]', f'{times[len(times) // 2] * 1e3:.2f}' if times else '-'),
                ('round trip max [ms]', f'{times[-1] * 1e3:.2f}' if times else '-')]


def _not_written(call: Call) -> str:
    """Why a call that interrupts was not sent; '' if it was."""
    if not call.written.is_set():
        return f'{call.request} was not written in time'
    outcome = call.outcome
    return f'{call.request}: {outcome.message}' if outcome and outcome.status == NOT_SENT else ''
