"""The link to the main control board: a Master that serves blocking callers and polls the air."""
import time
from typing import Any, Callable, List, NamedTuple, Optional, Tuple

from ..protocols import robot_ctrl_bus as bus
from ..protocols.framing import Frame
from .link import ERROR, OK, WARN, Link
from .master import NOT_SENT, PATIENCE, Call, Master, Outcome
from .port import Port, PortBusy, PortError

_SETTLE = 0.001     # s of silence before a move or a raw request: a doubled reply ends within
_BLOCKED = 0.05     # s until a port that took no data is tried again
_SLOW = (bus.LIFT, bus.GIMBAL)    # functions that move something


class BusSettings(NamedTuple):
    """Parameters of the session, in seconds where they are times."""

    reply_timeout: float = 0.5
    motion_timeout: float = 5.0
    retries: int = 2                   # beyond the first try, where a request may be repeated
    environment_period: float = 1.0    # 0: never
    environment_datelen: int = 2
    reply_has_cmd2: bool = False


class BusLink(Link):
    """Requests from any thread; each is answered, whatever happens to the port.

    Args:
        on_environment: is called in the link's thread with each reading and its stamp.
    """

    def __init__(self, port: Port, settings: BusSettings = BusSettings(),
                 on_environment: Optional[Callable[[bus.Environment, Any], None]] = None,
                 **link_arguments) -> None:
        super().__init__('bus', port, bus.ReplyDecoder(settings.reply_has_cmd2),
                         **link_arguments)
        self.settings = settings
        self.master = Master(settings.reply_timeout, settings.motion_timeout, self.log)
        self._on_environment = on_environment
        self._poll: Optional[Call] = None     # the latest
        self._next_poll = 0.0
        self._blocked_until = 0.0
        self._asks_environment = False        # what is outstanding is an environment request

    # -- for callers --------------------------------------------------------------------

    def lift(self, direction: int, distance: int) -> Outcome:
        """Move the lift by `distance` mm: direction 0 up, 1 down."""
        return self._move(bus.lift, direction, distance)

    def gimbal(self, direction: int, angle: int) -> Outcome:
        """Turn the gimbal by `angle` degrees: 0 left, 1 right, 2 up, 3 down."""
        return self._move(bus.gimbal, direction, angle)

    def environment(self) -> Tuple[Outcome, Optional[bus.Environment]]:
        """A fresh reading; None where there is none."""
        outcome = self.request(bus.ENVIRONMENT_REQUEST, repeatable=True)
        return outcome, bus.Environment.unpack(outcome.data) if outcome.success else None

    def echo(self) -> Outcome:
        """A round trip to the board and back."""
        return self.request(bus.echo(b'ping'), repeatable=True)

    def sync(self) -> Outcome:
        """Synchronise the channel."""
        return self.request(bus.SYNC_REQUEST, repeatable=True)

    def request(self, request: bus.Request, repeatable: bool = False) -> Outcome:
        """Send any request and wait for its outcome.

        It is sent again after a timeout only if `repeatable`. Answered within its timeout and
        the time that it waited for its turn, which is at most `motion_timeout` (0.8 s if that
        is shorter).
        """
        if len(request.data) > bus.MAX_LENGTH:
            return Outcome(NOT_SENT, 'data is %d bytes long, may be at most %d; nothing was sent'
                           % (len(request.data), bus.MAX_LENGTH))
        if not self.port.is_open:
            return Outcome(NOT_SENT, 'the port %s is closed (%s); nothing was sent'
                           % (self.port.url, self._trouble or 'not opened yet'))
        call = self._call(request, repeatable)
        self.master.submit(call)
        self.wake()
        settings = self.settings
        return call.wait(max(settings.motion_timeout, PATIENCE)
                         + call.tries * (call.timeout + PATIENCE))

    def _move(self, build: Callable[[int, int], bus.Request], direction: int,
              amount: int) -> Outcome:
        try:
            request = build(direction, amount)
        except ValueError as error:
            return Outcome(NOT_SENT, '%s; nothing was sent' % error)
        return self.request(request)

    def _call(self, request: bus.Request, repeatable: bool, poll: bool = False) -> Call:
        settings = self.settings
        slow = request.cmd1 == bus.FUNCTION and request.cmd2 in _SLOW
        return Call(request, settings.motion_timeout if slow else settings.reply_timeout,
                    repeatable, 1 + settings.retries, time.monotonic(), poll)

    # -- hooks --------------------------------------------------------------------------

    def opened(self, now: float) -> None:
        self._next_poll = now
        self.master.connected(now)

    def closed(self, now: float) -> None:
        self.master.disconnected(now, self._trouble or 'the bridge is stopping')

    def idle(self, now: float) -> Optional[float]:
        self.master.tick(now)
        return self.master.deadline()

    def received(self, frame: Frame, now: float) -> None:
        asked = self._asks_environment
        self.master.received(frame, now)
        if asked and not self.master.outstanding:
            self._asks_environment = False
            reply = frame.message
            if (self._on_environment and reply.cmd1 == bus.OK
                    and len(reply.data) == bus.Environment.LAYOUT.size):
                self._on_environment(bus.Environment.unpack(reply.data), frame.stamp)

    def damaged(self, frame: Frame, now: float) -> None:
        self.master.damaged(frame, now)

    def tick(self, now: float) -> Optional[float]:
        master = self.master
        while not self._stopping.is_set():
            self._poll_environment(now)
            master.tick(now)
            if not master.wants_to_send() or self.decoder.pending:
                break
            if now < self._blocked_until:
                return self._blocked_until
            if master.next_is_final() and now < self.last_byte_at + _SETTLE:
                return self.last_byte_at + _SETTLE
            # A request leaves only when everything received before it has been taken in.
            data = self.port.read(0)
            if data:
                self.last_byte_at = now = time.monotonic()
                self.take(data, self._clock(), now)
                continue
            self._send_next(time.monotonic())
        due = master.deadline()
        if self.settings.environment_period and master.synchronised:
            due = self._next_poll if due is None else min(due, self._next_poll)
        return due

    def _send_next(self, now: float) -> None:
        request = self.master.next_request(now)
        if request is None:
            return
        frame = bus.encode_request(request, self.settings.environment_datelen)
        self._asks_environment = request == bus.ENVIRONMENT_REQUEST
        try:
            self.send(frame, request.cmd1, request.cmd2, request.data, request)
        except PortBusy as error:
            self.log.warn('busy', '%s; is the board held by flow control?' % error)
            self.port.discard_output()
            self.master.not_sent(str(error))
            self._blocked_until = now + _BLOCKED
        except PortError:
            self.master.not_sent('the port has gone')
            raise

    def _poll_environment(self, now: float) -> None:
        period = self.settings.environment_period
        if not period or now < self._next_poll or not self.master.synchronised:
            return
        self._next_poll = max(self._next_poll + period, now)
        if self._poll is None or self._poll.outcome is not None:
            self._poll = self._call(bus.ENVIRONMENT_REQUEST, True, poll=True)
            self.master.submit(self._poll)

    # -- diagnostics --------------------------------------------------------------------

    def condition(self, now: float) -> Tuple[int, str]:
        if not self.port.is_open:
            return super().condition(now)
        amiss = self.master.condition()
        if not amiss:
            return OK, 'ready'
        return (ERROR if 'does not answer' in amiss else WARN), amiss

    def error_count(self) -> int:
        return super().error_count() + self.master.timeouts

    def own_values(self) -> List[Tuple[str, Any]]:
        times = sorted(self.master.round_trips)
        return [('timeouts', self.master.timeouts),
                ('round trip p50 [ms]', '%.2f' % (times[len(times) // 2] * 1e3) if times else '-'),
                ('round trip max [ms]', '%.2f' % (times[-1] * 1e3) if times else '-')]
