"""The link to the model car: commands down, measurements up, and the heartbeat that keeps the
motor alive. What may reach the motor, and when, is decided here and nowhere else."""
import threading
import time
import traceback
from collections import deque
from typing import Any, Callable, Deque, Iterable, List, NamedTuple, Optional, Tuple

from ...framing.stream import Frame
from ...link.link import OK, WARN, Link, Refused, Report
from ...transport.pace import Allowance, clock
from ...transport.port import Port, PortBusy, PortError
from . import DESCRIPTION, wire
from .calibration import Calibration, End
from .heart import Heart
from .motor import Motor, Stop

_STALLED = 0.05          # s of wire time that wait in the kernel: the port does not flow
_LOOK_PERIOD = 0.1       # s from one look at what waits there to the next
_LAST_WORD = 0.1         # s that SPEED 0 has to leave the port at the end
_SPEED_0 = wire.SpeedCommand(0)
_HEARTBEAT = wire.Heartbeat()
_HEARTBEAT_PACKET = wire.encode(_HEARTBEAT)
_BOARD_LINES = 100, 10.0     # log lines of the board's in a burst, and a second after that


class ArduinoSettings(NamedTuple):
    """Parameters of the session, in seconds where they are times."""

    heartbeat_rate: float = 100.0        # Hz
    speed_timeout: float = 0.5           # 0: never
    calibration_timeout: float = 900.0   # a calibration without an end is over after this
    check_plausibility: bool = True
    # A network port is opened anew after this; 0: never.
    network_silence: float = DESCRIPTION.network_silence


class ArduinoLink(Link):
    """Commands from any thread; they reach an open port at once or are refused.

    Args:
        on_message: is called in the link's thread with each (message, stamp) but the logs.
        on_log: likewise with each (severity 0 … 3, text), sparingly if they are many.
        on_calibrating: is called with True and False as a calibration begins and ends.
        messages: classes of messages of one's own that the board sends.
        link_arguments: frame_timeout, clock and logger, as `Link` has them.
    """

    STOPS_FIRST = True

    def __init__(self, port: Port, settings: ArduinoSettings = ArduinoSettings(),
                 on_message: Optional[Callable[[Any, Any], None]] = None,
                 on_log: Optional[Callable[[int, str], None]] = None,
                 on_calibrating: Optional[Callable[[bool], None]] = None,
                 messages: Iterable[Any] = (), **link_arguments) -> None:
        super().__init__('arduino', port, wire.Decoder(settings.check_plausibility, messages),
                         **link_arguments)
        self.settings = settings
        self._on_message = on_message
        self._on_log = on_log
        self._on_calibrating = on_calibrating
        self._sending = threading.Lock()     # all that is sent, and the state of it:
        self._motor = Motor(settings.speed_timeout, clock())
        self._cut_off = False                # the latest packet may have left in part
        self._finished = False               # SPEED 0 was the last word
        self._calibration: Optional[Calibration] = None
        self._look_at = 0.0                  # when to look again at what waits in the kernel
        self._heart = Heart('arduino heartbeat', settings.heartbeat_rate, self._beat,
                            lambda text: self._log_later('fault', text),
                            lambda text: self._log_later('priority', text, self.log.info))
        self._recent_gap = 0.0               # s; between heartbeats, since the report before
        self._unlogged: Deque[Tuple[Callable[[str, str], None], str, str]] = deque()
        self._board_lines = Allowance(*_BOARD_LINES)

    @property
    def heartbeats_sent(self) -> int:
        """Since the start."""
        return self._heart.beats

    @property
    def calibrating(self) -> bool:
        """Whether the board calibrates its IMU; it then reads nothing for minutes."""
        return self._calibration is not None

    # -- commands -----------------------------------------------------------------------

    def set_speed(self, value: int) -> None:
        """PWM of the drive motor, saturated to ±1000; Refused where it cannot be sent now."""
        limit = wire.SPEED_LIMIT
        if not -limit <= value <= limit:
            self.log.warn('saturated', f'speed {value} is beyond {limit} either way; sent as that')
            value = limit if value > 0 else -limit
        self.command(wire.SpeedCommand(value))

    def set_steering(self, value: int) -> None:
        """PWM of the steering servo in µs, 0 … 65535; Refused where it cannot be sent now."""
        self.command(wire.SteeringCommand(value))

    def set_led(self, text: str) -> None:
        """left, right, brake, disable …; Refused also if it is too long or not ASCII."""
        self.command(wire.LedCommand(text))

    def calibrate_imu(self) -> None:
        """Send IMU_CALIBRATION, after SPEED 0 if the car moves; Refused if it cannot be sent.

        From then on commands are refused until the calibration is over (see `Calibration`): the
        board would read them minutes later, all at once.
        """
        self.command(wire.ImuCalibration())
        if self._on_calibrating:
            self._on_calibrating(True)

    def command(self, message: Any) -> None:
        """Send any message to the board at once; Refused where it cannot be sent now."""
        try:
            reason = message.implausible()
            if reason:
                raise ValueError(reason)
            wire.encode(message)     # or it is too long, and would fill a log line, too
        except ValueError as error:
            too_long = len(getattr(message, 'text', '')) > wire.LED_LIMIT
            raise Refused(f'{message.LABEL} refused: {error}',
                          'too long' if too_long else 'value') from None
        with self._sending:
            now = clock()
            self._check_for_stall(now)
            self._refuse_if_unfit(message, now)
            calibration = isinstance(message, wire.ImuCalibration)
            try:
                if calibration and self._motor.moving:
                    self._send_packet(_SPEED_0, now)
                self._send_packet(message, now)
            except (PortBusy, PortError) as error:
                # Output that is stuck is dropped by the heart, before anything else is sent.
                busy = isinstance(error, PortBusy)
                raise Refused(f'{message} refused: {error}', 'busy' if busy else 'port') from None
            if calibration:
                self._calibration = Calibration(self.settings.calibration_timeout, now)

    def _refuse_if_unfit(self, message: Any, now: float) -> None:
        if self._finished:
            raise Refused(f'{message} refused: the bridge is stopping', 'stopping')
        if self.calibrating:
            raise Refused(f'{message} refused: the IMU is being calibrated, '
                          'which takes minutes', 'calibrating')
        if self._motor.ignores_commands(now):
            raise Refused(f'{message} refused: it may have waited while the bridge stood still; '
                          'send it again', 'stall')
        if self.port.backlog() > _STALLED:
            raise Refused(f'{message} refused: the port takes no data', 'busy')

    # -- sending; everything below holds the lock -----------------------------------------

    def _send_packet(self, message: Any, now: float) -> None:
        """Write one packet, and SPEED 0 before it where that has to be the first to leave.

        Raises:
            PortBusy, PortError: it has not been sent; SPEED 0 may have been.
        """
        if self._motor.in_doubt and message != _SPEED_0:
            self._send_packet(_SPEED_0, now)
        if message is _HEARTBEAT and not (self.tap or self._cut_off):
            # The same three bytes a hundred times a second, which nobody looks at.
            self.port.write(_HEARTBEAT_PACKET)
            self.frames_sent += 1
            return
        data = message.pack()
        packet = wire.encode_raw(message.TYPE, data)
        # After a packet that was cut off, a 0x00 first: it ends what the board has of it.
        packet = b'\0' + packet if self._cut_off else packet
        self.port.write(packet)
        self._cut_off = False
        if isinstance(message, wire.SpeedCommand):
            self._motor.sent(message.value, now)    # before anything that may fail
        self.written(packet, message.TYPE, 0, data, message)

    def _check_for_stall(self, now: float) -> None:
        # The link's thread has the priority of those that receive commands.
        stalled_for = self._motor.noticed_stall(now, self.awake_at)
        if stalled_for is not None:
            self._log_later('stall', f'the bridge stood still for {stalled_for:.3g} s: SPEED 0 '
                            'goes first, what was commanded meanwhile is dropped')

    def _unblock(self) -> None:
        """The port does not flow: drop what waits, or it reaches the board late, commands too."""
        self._motor.expect_any_speed()
        self._cut_off = True
        dropped = self.port.discard_output()
        self._log_later('stalled', 'the port takes no data; ' + (
            'what waited was dropped' if dropped else 'the connection is broken off')
                        + ', the board stops its motor')

    # -- the heart ------------------------------------------------------------------------

    def start(self) -> None:
        self._motor.awake(clock())
        super().start()
        self._heart.start()

    def stop(self) -> None:
        """SPEED 0, then silence."""
        self._heart.stop(_LAST_WORD)
        with self._sending:
            self._finished = True       # no heartbeat follows the last word
            try:
                if self.port.backlog() > _STALLED:
                    self._unblock()
                self._send_packet(_SPEED_0, clock())
            except (PortBusy, PortError):
                pass     # closed, or stuck: without heartbeats the board stops by itself
            except Exception:  # pylint: disable=broad-except
                self._log_later('fault', traceback.format_exc())
        self._wait_until_sent()
        super().stop()

    def _wait_until_sent(self) -> None:
        """Closing a port may drop what it has not sent yet: give the last word its time."""
        deadline = time.monotonic() + _LAST_WORD
        while self.port.on_its_way() and time.monotonic() < deadline:
            time.sleep(0.002)

    def _beat(self, beat: bool) -> bool:
        """In the heart's thread: SPEED 0 if it is due, then a heartbeat if that is."""
        with self._sending:
            now = clock()       # not sooner: a stall may have come between
            self._check_for_stall(now)
            self._motor.awake(now)
            if self._finished or not self.port.is_open:
                return False
            try:
                if now >= self._look_at:
                    self._look_at = now + _LOOK_PERIOD
                    if self.port.backlog() > _STALLED:
                        self._unblock()
                why = self._motor.due(now, self._board_reads(now))
                if why:
                    self._send_packet(_SPEED_0, now)
                if why is Stop.TIMED_OUT:
                    self._log_later('speed timeout', 'no speed command for '
                                    f'{self.settings.speed_timeout:g} s: SPEED 0 sent')
                if beat:
                    self._send_packet(_HEARTBEAT, now)
                return beat
            except PortBusy:
                self._unblock()     # and no heartbeat leaves before SPEED 0 does
            except PortError:
                pass                # the link's thread sees it as well
            return False

    def _board_reads(self, now: float) -> bool:
        """Whether the board takes commands: not while it calibrates. As long as its IMU data goes
        on, the line may have lost the request to calibrate, and the SPEED 0 before it."""
        calibration = self._calibration
        return calibration is None or calibration.data_goes_on(now)

    def _log_later(self, cause: str, text: str,
                   say: Optional[Callable[[str, str], None]] = None) -> None:
        """Have the link's thread log it: a log may block, a heartbeat and a command may not."""
        self._unlogged.append((say or self.log.warn, cause, text))
        self.wake()

    # -- hooks --------------------------------------------------------------------------

    def opened(self, now: float) -> None:
        self._heart.opened(clock())
        if self._calibration:
            self._calibration.port_opened(clock())

    def closed(self, now: float) -> None:
        # At once, not as it opens again: from then on anybody may be the first to write.
        with self._sending:
            if self._motor.moving and not self._finished:
                self._log_later('moved', 'the car may have been moving when the port went: '
                                         'SPEED 0 is sent first when it returns')
            self._motor.expect_any_speed()
            self._cut_off = False
            self._heart.restart()

    def stalled(self, seconds: float, now: float) -> None:
        if self._calibration:
            self._calibration.stalled(seconds, clock())

    def altered(self, now: float) -> None:
        with self._sending:
            self._motor.expect_any_speed()
            self._cut_off = True

    def received(self, frame: Frame, now: float) -> None:
        message = frame.message
        if isinstance(message, wire.Log):
            self._board_says(message, now)
            return
        if isinstance(message, wire.Imu) and self._calibration:
            self._calibrated(self._calibration.imu_data(clock()))
        if self._on_message:
            self._on_message(message, frame.stamp)

    def tick(self, now: float) -> Optional[float]:
        self._log_what_waits()
        if self._calibration:
            self._calibrated(self._calibration.look(clock()))
        if self._calibration:
            return None     # it may be silent, and this is called every 0.1 s anyway
        try:
            return self.check_silence(now, self.settings.network_silence)
        except PortError:
            self._end_with_speed_0()
            raise

    def idle(self, now: float) -> Optional[float]:
        self._log_what_waits()
        if self._calibration:
            self._calibrated(self._calibration.look(clock()))
        return None

    def _log_what_waits(self) -> None:
        while self._unlogged:
            say, cause, text = self._unlogged.popleft()
            say(cause, text)

    def _end_with_speed_0(self) -> None:
        """What waits for the board behind a network, out of reach, ends with SPEED 0."""
        with self._sending:
            try:
                self._send_packet(_SPEED_0, clock())
            except (PortBusy, PortError):
                pass

    def _calibrated(self, end: Optional[End]) -> None:
        """The calibration is over, if there is a reason."""
        if end is None:
            return
        self._calibration = None
        if end is End.BACK:
            self.log.info('calibrated', end.value)
        else:
            self.log.warn('not calibrated', end.value.format(self.settings.calibration_timeout))
        if self._on_calibrating:
            self._on_calibrating(False)

    def _board_says(self, message: wire.Log, now: float) -> None:
        if not self._board_lines.take(now):
            self.log.warn('chatter', 'the board logs too much; lines of it are left out')
            return
        if self._on_log:
            self._on_log(message.severity, message.text)

    def talks(self, now: float) -> Optional[bool]:
        return None if self.calibrating else super().talks(now)     # deaf and dumb for minutes

    def report(self, now: float) -> Report:
        self._recent_gap = self._heart.recent_gap(clock())
        return super().report(now)

    def condition(self, now: float) -> Tuple[int, str]:
        level, summary = super().condition(now)
        if not self.port.is_open:
            return level, summary
        if self.calibrating:
            return WARN if level else OK, 'calibrating the IMU'
        if self._recent_gap <= DESCRIPTION.heartbeat.longest_gap:
            return level, summary
        gap = (f'heartbeat gap of {self._recent_gap * 1e3:.1f} ms: after 30 ms the board stops '
               'its motor; see "Let the bridge come first" in doc/troubleshooting.md')
        return WARN, gap if level == OK else f'{summary}; {gap}'

    def own_values(self) -> List[Tuple[str, Any]]:
        return [('heartbeats sent', self.heartbeats_sent),
                ('heartbeat gap [ms]', f'{self._recent_gap * 1e3:.2f}'),
                ('heartbeat max gap [ms]', f'{self._heart.max_gap * 1e3:.2f}')]
