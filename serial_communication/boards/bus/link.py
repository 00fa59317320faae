"""The link to the main control board: a Master that serves blocking callers and polls."""
import os
import time
from typing import Any, Callable, List, NamedTuple, Optional, Tuple

from ...framing.layout import Layout
from ...framing.stream import Frame
from ...link.backlog import LONGEST_SLEEP
from ...link.link import ERROR, OK, WARN, Link
from ...link.outcome import NOT_SENT, Outcome
from ...transport.pace import Every
from ...transport.port import Port, PortBusy, PortError
from . import wire
from .master import PATIENCE, Call, Condition, Master

_BLOCKED = 0.05     # s until a port that took no data is tried again
_SLOW = (wire.LIFT, wire.GIMBAL)    # functions that move something


class BusSettings(NamedTuple):
    """Parameters of the session, in seconds where they are times."""

    reply_timeout: float = 0.5
    motion_timeout: float = 5.0
    retries: int = 2                   # beyond the first try, where a request may be repeated
    environment_period: float = 1.0    # 0: never
    environment_datelen: int = 2
    reply_has_cmd2: bool = False


class _Poller:
    """Asks one thing every `period` seconds, unless the time before has no outcome yet.

    Args:
        period: s.
        ask: submits the request; returns its call.
    """

    def __init__(self, period: float, ask: Callable[[], Call]) -> None:
        self.pace = Every(period, 0.0)
        self._period = period
        self._ask = ask
        self._latest: Optional[Call] = None

    def start(self, now: float) -> None:
        """The periods count from here."""
        self.pace = Every(self._period, now - self._period)     # the first one at once

    def tick(self, now: float) -> None:
        """Ask if it is time; what was missed meanwhile is not made up for."""
        if not self.pace.passed(now):
            return
        if self._latest is None or self._latest.outcome is not None:
            self._latest = self._ask()


class BusLink(Link):
    """Requests from any thread; each is answered, whatever happens to the port.

    Args:
        on_environment: is called in the link's thread with each reading and its stamp.
        link_arguments: frame_timeout, clock and logger, as `Link` has them.
    """

    def __init__(self, port: Port, settings: BusSettings = BusSettings(),
                 on_environment: Optional[Callable[[wire.Environment, Any], None]] = None,
                 **link_arguments) -> None:
        super().__init__('bus', port, wire.ReplyDecoder(settings.reply_has_cmd2),
                         **link_arguments)
        self.settings = settings
        self.master = Master(settings.reply_timeout, settings.motion_timeout, self.log)
        self._on_environment = on_environment
        self._pollers: List[_Poller] = []
        self._blocked_until = 0.0
        self._due = 0.0         # when something is due by time, at the latest
        if settings.environment_period:
            self.poll(settings.environment_period, wire.ENVIRONMENT_REQUEST,
                      wire.Environment.LAYOUT, self._environment_came)

    # -- for callers --------------------------------------------------------------------

    def lift(self, direction: int, distance: int) -> Outcome:
        """Move the lift by `distance` mm: direction 0 up, 1 down."""
        return self._move(wire.lift, direction, distance)

    def gimbal(self, direction: int, angle: int) -> Outcome:
        """Turn the gimbal by `angle` degrees: 0 left, 1 right, 2 up, 3 down."""
        return self._move(wire.gimbal, direction, angle)

    def environment(self) -> Tuple[Outcome, Optional[wire.Environment]]:
        """A fresh reading; None where there is none."""
        outcome = self.request(wire.ENVIRONMENT_REQUEST, repeatable=True,
                               reply_layout=wire.Environment.LAYOUT,
                               on_success=self._environment_came)
        return outcome, wire.Environment.unpack(outcome.data) if outcome.success else None

    def echo(self) -> Outcome:
        """A round trip to the board and back."""
        return self.request(wire.echo(os.urandom(4)), repeatable=True)

    def sync(self) -> Outcome:
        """Synchronise the channel."""
        return self.request(wire.SYNC_REQUEST, repeatable=True)

    def request(self, request: wire.Request, repeatable: bool = False,
                timeout: Optional[float] = None, reply_layout: Optional[Layout] = None,
                on_success: Optional[Callable[[Outcome], None]] = None) -> Outcome:
        """Send any request and wait for its outcome.

        Answered within its timeout and the time that it waited for its turn, which is at most
        `motion_timeout` (0.8 s if that is shorter).

        Args:
            repeatable: it may be sent again after a timeout: it merely reads.
            timeout: s from sending to the reply; None: as the settings have it for its kind.
            reply_layout: what data its OK must have; None: any. `NO_DATA`: none is expected, but
                a board may send some.
            on_success: is called in the link's thread with a successful outcome, before or
                after this returns.
        """
        if len(request.data) > wire.MAX_LENGTH:
            return Outcome(NOT_SENT, f'data is {len(request.data)} bytes long, may be at most '
                           f'{wire.MAX_LENGTH}; nothing was sent')
        if not self.port.is_open:
            return Outcome(NOT_SENT, f'the port {self.port.url} is closed '
                           f'({self._trouble or "not opened yet"}); nothing was sent')
        call = self._call(request, repeatable, timeout, reply_layout, on_success)
        self.master.submit(call)
        self.wake()
        return call.wait(max(self.settings.motion_timeout, PATIENCE)
                         + call.tries * (call.timeout + PATIENCE))

    def poll(self, period: float, request: wire.Request, reply_layout: Optional[Layout],
             on_success: Callable[[Outcome], None], timeout: Optional[float] = None) -> None:
        """From the start on, send this repeatable request every `period` seconds.

        To be called before `start`. The arguments are those of `request`.
        """
        def ask() -> Call:
            call = self._call(request, True, timeout, reply_layout, on_success, poll=True)
            self.master.submit(call)
            return call

        self._pollers.append(_Poller(period, ask))

    def _move(self, build: Callable[[int, int], wire.Request], direction: int,
              amount: int) -> Outcome:
        try:
            request = build(direction, amount)
        except ValueError as error:
            return Outcome(NOT_SENT, f'{error}; nothing was sent')
        return self.request(request, reply_layout=wire.NO_DATA)

    def _call(self, request: wire.Request, repeatable: bool, timeout: Optional[float],
              reply_layout: Optional[Layout], on_success: Optional[Callable[[Outcome], None]],
              poll: bool = False) -> Call:
        settings = self.settings
        if timeout is None:
            slow = request.cmd1 == wire.FUNCTION and request.cmd2 in _SLOW
            timeout = settings.motion_timeout if slow else settings.reply_timeout
        return Call(request, timeout, repeatable, 1 + settings.retries, time.monotonic(), poll,
                    reply_layout, on_success)

    def _environment_came(self, outcome: Outcome) -> None:
        if self._on_environment:
            self._on_environment(wire.Environment.unpack(outcome.data), outcome.stamp)

    # -- hooks --------------------------------------------------------------------------

    def opened(self, now: float) -> None:
        for poller in self._pollers:
            poller.start(now)
        self.master.connected(now)
        self._due = now

    def closed(self, now: float) -> None:
        self.master.disconnected(now, self._trouble or 'the bridge is stopping')

    def idle(self, now: float) -> Optional[float]:
        return self.master.step(now, may_send=False)[1]

    def received(self, frame: Frame, now: float) -> None:
        self.master.received(frame, now)

    def shown(self, frame: Frame) -> Frame:
        request = self.master.asked
        if frame.cause or not isinstance(request, wire.NamedRequest):
            return frame
        return frame._replace(message=request.function.answer(frame.message))

    def damaged(self, frame: Frame, now: float) -> None:
        self.master.damaged(frame, now)

    def stalled(self, seconds: float, now: float) -> None:
        self.master.missed('the bridge stalled', now)

    def altered(self, now: float) -> None:
        self.master.missed('the settings of the port were changed', now)

    def tick(self, now: float) -> Optional[float]:
        if not self.drained and now < self._due:
            return now      # nothing may be sent before the port has been read empty
        times = [now + LONGEST_SLEEP]
        if self.master.synchronised:
            for poller in self._pollers:
                poller.tick(now)
                times.append(poller.pace.due)
        # A request leaves only when everything received before it has been taken in.
        may_send = (self.drained and not self.decoder.begun and not self.drops
                    and now >= self._blocked_until)
        request, wake_at = self.master.step(now, may_send)
        if request is not None:
            self._send_request(request, now)
        if wake_at is not None:
            times.append(wake_at)
        if now < self._blocked_until:
            times.append(self._blocked_until)
        self._due = min(times)
        return self._due if self.drained else now

    def _send_request(self, request: wire.Request, now: float) -> None:
        frame = wire.encode_request(request, self.settings.environment_datelen)
        try:
            self.send(frame, request.cmd1, request.cmd2, request.data, request)
        except PortBusy as error:
            self.log.warn('busy', f'{error}; is the board held by flow control?')
            self.port.discard_output()
            self.master.not_sent(str(error))
            self._blocked_until = now + _BLOCKED
        except PortError:
            self.master.not_sent('the port has gone')
            raise

    # -- diagnostics --------------------------------------------------------------------

    def condition(self, now: float) -> Tuple[int, str]:
        if not self.port.is_open:
            return super().condition(now)
        amiss = self.master.condition()
        if amiss is Condition.READY:
            return OK, 'ready'
        return ERROR if amiss in (Condition.NO_SYNC, Condition.NO_ECHO) else WARN, amiss.value

    def talks(self, now: float) -> Optional[bool]:
        # It talks only when it is asked.
        # That it answers no ECHO is reported by the master: there are boards that know none.
        return {Condition.READY: True, Condition.NO_SYNC: False}.get(self.master.condition())

    def silence(self) -> str:
        return (f'{self.master.condition().value}; asking on: has it power, is it wired, and is '
                f'{self.port.baud} baud right?')

    def error_count(self) -> int:
        master = self.master
        return (super().error_count() + master.timeouts + master.length_errors
                + master.implausible)

    def own_values(self) -> List[Tuple[str, Any]]:
        times = sorted(self.master.round_trips)
        return [('timeouts', self.master.timeouts),
                ('length errors', self.master.length_errors),
                ('implausible errors', self.master.implausible),
                ('round trip p50 [ms]', f'{times[len(times) // 2] * 1e3:.2f}' if times else '-'),
                ('round trip max [ms]', f'{times[-1] * 1e3:.2f}' if times else '-')]
