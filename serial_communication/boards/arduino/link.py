"""The link to the model car: takes commands, sends heartbeats, receives measurements."""
from typing import Any, Callable, Iterable, List, NamedTuple, Optional, Tuple, Type

from ...framing.announcement import Chunk
from ...framing.layout import LayoutMessage
from ...framing.settings import SettingMessage
from ...framing.stream import Frame
from ...link.link import OK, WARN, Link, Refused, Report
from ...transport.pace import Allowance
from ...transport.port import Port, PortError
from . import DESCRIPTION, LONGEST_GAP, wire
from .calibration import End
from .heartbeat import HeartbeatThread
from .output import CarOutput

_HEARTBEAT_END = 0.1    # s for the heartbeat's thread to end
_BOARD_LINES = 100, 10.0     # log lines of the board that are taken: in a burst, then per second


class ArduinoSettings(NamedTuple):
    """Parameters of the session; times are in s."""

    heartbeat_rate: float = 100.0        # Hz
    speed_timeout: float = 0.5           # 0: never
    calibration_timeout: float = 900.0   # after this time a calibration counts as over
    check_plausibility: bool = True
    # After this silence of the board a network port is closed and opened again, and on a pseudo
    # terminal commands are refused; 0: never.
    network_silence: float = DESCRIPTION.network_silence


class ArduinoLink(Link):
    """Takes commands from any thread; each is sent at once, or refused.

    Args:
        on_message: called in the link's thread with the (message, stamp) of each message except
            log messages, announcements and TIME.
        on_log: called in the link's thread with the (severity 0 … 3, text) of each log message; if
            the board sends too many, some are dropped.
        on_calibrating: called with True when a calibration begins, with False when it ends.
        messages: classes of custom messages that the board sends.
        link_arguments: frame_timeout, clock, board_time and logger, as for `Link`.
    """

    STOPS_FIRST = True
    PRINT_TO = 'bridge.log'     # of the library's PacketLink

    def __init__(self, port: Port, settings: ArduinoSettings = ArduinoSettings(),
                 on_message: Optional[Callable[[Any, Any], None]] = None,
                 on_log: Optional[Callable[[int, str], None]] = None,
                 on_calibrating: Optional[Callable[[bool], None]] = None,
                 messages: Iterable[Type[LayoutMessage]] = (), **link_arguments: Any) -> None:
        super().__init__('arduino', port, wire.Decoder(settings.check_plausibility, messages),
                         **link_arguments)
        self.settings = settings
        self.output = CarOutput(self, settings.speed_timeout, settings.calibration_timeout)
        self.heartbeat = HeartbeatThread(
            'arduino heartbeat', settings.heartbeat_rate, self.output.send_what_is_due,
            lambda text: self.log.warn('fault', text), self.now)
        self.lending.let_go = self.output.let_go
        self.lending.was_reset = lambda: self._end_calibration(End.RESET)
        self._on_message = on_message
        self._on_log = on_log
        self._on_calibrating = on_calibrating
        self._recent_gap = 0.0               # s; longest recent gap, when the last report was made
        self._board_lines = Allowance(*_BOARD_LINES)

    @property
    def heartbeats_sent(self) -> int:
        """Heartbeats since the start."""
        return self.heartbeat.sent + self.output.extra_beats

    @property
    def calibrating(self) -> bool:
        """Whether the board calibrates its IMU: it reads no commands for minutes."""
        return self.output.calibration is not None

    # -- commands -----------------------------------------------------------------------

    def set_speed(self, value: int) -> None:
        """Send a speed, the PWM of the drive motor, saturated to -1000 … 1000; see `command`."""
        limit = wire.SPEED_LIMIT
        if not -limit <= value <= limit:
            saturated = limit if value > 0 else -limit
            self.log.warn('saturated', f'speed {value} is out of range (-{limit} … {limit}), '
                          f'sent {saturated}')
            value = saturated
        self.command(wire.SpeedCommand(value))

    def set_steering(self, value: int) -> None:
        """Send the PWM of the steering servo in µs, 0 … 65535; see `command`."""
        self.command(wire.SteeringCommand(value))

    def set_led(self, text: str) -> None:
        """Send an LED command: left, right, brake, disable …; at most 30 ASCII characters; see
        `command`."""
        self.command(wire.LedCommand(text))

    def calibrate_imu(self) -> None:
        """Send IMU_CALIBRATION, and SPEED 0 before it if the car moves; see `command`.

        Commands are refused until the calibration is over (see `Calibration`): the board would
        read them minutes later, all at once.
        """
        self.command(wire.ImuCalibration())
        if self._on_calibrating:
            self._on_calibrating(True)

    def command(self, message: LayoutMessage) -> None:
        """Send a message; Refused for a value out of range, or if it cannot be sent now."""
        try:
            reason = message.implausible()
            if reason:
                raise ValueError(reason)
            wire.encode(message)     # before any log line quotes a text that is too long
        except ValueError as error:
            raise Refused(f'{message.LABEL} refused: {error}', 'value') from None
        self.output.command(message)

    def add_motion(self, zero: LayoutMessage) -> None:
        """Have ~stop send this message: the zero of a command that moves something."""
        if not wire.is_speed_0(zero):       # the output has that one built in
            self.output.add_motion(zero)

    def remove_motion(self, zero: LayoutMessage) -> None:
        """Undo `add_motion`."""
        self.output.remove_motion(zero)

    def stop_motion(self) -> str:
        return self.output.stop_motions()

    # -- start and stop -------------------------------------------------------------------

    def loops(self) -> List[Callable[[], float]]:
        return [*super().loops(), self.heartbeat.step]

    def start(self) -> None:
        self.output.motor.awake(self.now())
        super().start()
        self.log.info('priority', self.heartbeat.start())

    def stop(self) -> None:
        """Send SPEED 0, and nothing after it."""
        self.heartbeat.stop(_HEARTBEAT_END)
        self.output.end()
        super().stop()

    # -- hooks --------------------------------------------------------------------------

    def opened(self, now: float) -> None:
        self.output.opened()
        self.heartbeat.port_opened(self.now())
        if self.output.calibration:
            self.output.calibration.port_opened(self.now())

    def closed(self, now: float) -> None:
        self.output.closed()
        self.heartbeat.port_closed()

    def stalled(self, seconds: float, now: float) -> None:
        if self.output.calibration:
            self.output.calibration.stalled(seconds, self.now())

    def altered(self, now: float) -> None:
        self.output.altered()

    def received(self, frame: Frame, now: float) -> None:
        message = frame.message
        if isinstance(message, wire.Log):
            self._log_received(message, now)
        elif isinstance(message, Chunk):
            self.announcement.add(message)
        elif isinstance(message, SettingMessage):
            self.board_settings.received(message, self.announcement.is_current)
        elif not isinstance(message, wire.Time):
            if self.output.calibration and isinstance(message, wire.Imu):
                self._end_calibration(self.output.calibration.imu_data(self.now()))
            if self._on_message and not self.announcement.holds_back(message):
                self.connection.guarded(self._on_message, message, frame.stamp)

    def tick(self, now: float) -> Optional[float]:
        self.idle(now)
        if self.calibrating:
            return None     # the board may be silent
        self._check_pty(now)
        due = self.board_settings.send(now, self.output.command, self.announcement.is_current)
        try:
            silent_at = self.check_silence(now, self.settings.network_silence)
        except PortError:
            # Behind the commands that wait in the network, which cannot be dropped.
            self.output.send_speed_0()
            raise
        return min((at for at in (due, silent_at) if at is not None), default=None)

    def _check_pty(self, now: float) -> None:
        """Hold commands back from a pseudo terminal while a board that has talked is silent.

        Its other side (socat, ser2net, a virtual machine) may stand, and send all of them later.
        What it can read already cannot be dropped, but has SPEED 0 behind it then. Heartbeats go
        on: the board may read.
        """
        limit, has_talked = self.settings.network_silence, self.last_frame_at is not None
        silent_for = now - self.connection.last_byte_at if has_talked else 0.0
        held = self.port.is_pty and 0 < limit <= silent_for
        if held == self.output.is_held:
            return
        self.output.hold(held)
        if held:
            self.log.warn('silent', f'nothing received from the board for {limit:g} s: what was '
                          'written is dropped, SPEED 0 is sent, and commands are refused until '
                          'it talks')

    def idle(self, now: float) -> Optional[float]:
        if self.output.calibration:
            self._end_calibration(self.output.calibration.check_timeout(self.now()))
        return None

    def _end_calibration(self, end: Optional[End]) -> None:
        """End the calibration, if there is one, for this reason; None: it is not over."""
        if end is None or not self.calibrating:
            return
        self.output.calibration = None
        if end in (End.BACK, End.RESET):
            self.log.info('calibrated', end.value)
        else:
            self.log.warn('not calibrated', end.value.format(self.settings.calibration_timeout))
        if self._on_calibrating:
            self._on_calibrating(False)

    def _log_received(self, message: wire.Log, now: float) -> None:
        if not self._board_lines.take(now):
            self.log.warn('chatter', 'the board logs too much (over {} lines at once or {:g} a '
                          'second): some lines are left out'.format(*_BOARD_LINES))
        elif self._on_log:
            self._on_log(message.severity, message.text)

    def talks(self, now: float) -> Optional[bool]:
        return None if self.calibrating else super().talks(now)     # then it is silent for minutes

    # -- diagnostics ----------------------------------------------------------------------

    def report(self, now: float) -> Report:
        self._recent_gap = self.heartbeat.recent_gap(self.now())
        return super().report(now)

    def condition(self, now: float) -> Tuple[int, str]:
        level, summary = super().condition(now)
        if not self.port.is_open:
            return level, summary
        if self.calibrating:
            return WARN if level else OK, 'calibrating the IMU'
        if self._recent_gap <= LONGEST_GAP:
            return level, summary
        gap = (f'heartbeat gap of {self._recent_gap * 1e3:.1f} ms: after 30 ms the board stops '
               'its motor; see "Let the bridge come first" in doc/troubleshooting.md')
        return WARN, gap if level == OK else f'{summary}; {gap}'

    def condition_of_board(self, now: float) -> str:
        return 'calibrating' if self.calibrating else super().condition_of_board(now)

    def extra_values(self) -> List[Tuple[str, Any]]:
        return [('heartbeats sent', self.heartbeats_sent),
                ('heartbeat gap [ms]', f'{self._recent_gap * 1e3:.2f}'),
                ('heartbeat max gap [ms]', f'{self.heartbeat.max_gap * 1e3:.2f}')]
