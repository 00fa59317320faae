"""The link to the model car: sends commands and heartbeats, receives measurements.

Only this module, `motor` and `calibration` decide what may reach the motor, and when.
"""
import threading
import time
import traceback
from collections import deque
from typing import Any, Callable, Deque, Iterable, List, NamedTuple, Optional, Tuple, Type

from ...framing.announcement import Chunk
from ...framing.layout import LayoutMessage
from ...framing.stream import Frame
from ...link.link import OK, WARN, Link, Refused, Report
from ...transport.pace import Allowance, clock
from ...transport.port import Port, PortBusy, PortError
from . import DESCRIPTION, LONGEST_GAP, wire
from .calibration import Calibration, End
from .heartbeat import HeartbeatThread
from .motor import Motor, Stop

_MOST_BACKLOG = 0.05     # s of wire time that may wait in the kernel; more: the port is blocked
_BACKLOG_PERIOD = 0.1    # s between two checks of the backlog
_LAST_STOP_TIME = 0.1    # s for the last SPEED 0 to leave the port before it is closed
_SPEED_0 = wire.SpeedCommand(0)
_HEARTBEAT = wire.Heartbeat()
_HEARTBEAT_PACKET = wire.encode(_HEARTBEAT)
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
    """Takes commands from any thread; each is written to an open port at once, or refused.

    Args:
        on_message: called in the link's thread with the (message, stamp) of each message except
            log messages and announcements.
        on_log: called in the link's thread with the (severity 0 … 3, text) of each log message; if
            the board sends too many, some are dropped.
        on_calibrating: called with True when a calibration begins, with False when it ends.
        messages: classes of custom messages that the board sends.
        link_arguments: frame_timeout, clock and logger, as for `Link`.
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
        self._on_message = on_message
        self._on_log = on_log
        self._on_calibrating = on_calibrating
        # Held while anything is sent. It also guards the next six attributes.
        self._send_lock = threading.Lock()
        self._motor = Motor(settings.speed_timeout, clock())
        self._cut_off = False                # the latest packet may have been sent in part
        self._held = False                   # the other side of a pty may hold what is written
        self._stopped = False                # the last SPEED 0 is sent: nothing may follow it
        self._calibration: Optional[Calibration] = None
        self._check_backlog_at = 0.0
        self._heartbeat = HeartbeatThread(
            'arduino heartbeat', settings.heartbeat_rate, self._send_what_is_due,
            lambda text: self._log_later('fault', text),
            lambda text: self._log_later('priority', text, self.log.info))
        self._recent_gap = 0.0               # s; longest recent gap, when the last report was made
        self._unlogged: Deque[Tuple[Callable[[str, str], None], str, str]] = deque()
        self._board_lines = Allowance(*_BOARD_LINES)

    @property
    def heartbeats_sent(self) -> int:
        """Heartbeats since the start."""
        return self._heartbeat.sent

    @property
    def calibrating(self) -> bool:
        """Whether the board calibrates its IMU: it reads no commands for minutes."""
        return self._calibration is not None

    # -- commands -----------------------------------------------------------------------

    def set_speed(self, value: int) -> None:
        """Send a speed, the PWM of the drive motor, saturated to -1000 … 1000.

        Raises:
            Refused: it cannot be sent now.
        """
        limit = wire.SPEED_LIMIT
        if not -limit <= value <= limit:
            saturated = limit if value > 0 else -limit
            self.log.warn('saturated', f'speed {value} is out of range (-{limit} … {limit}), '
                          f'sent {saturated}')
            value = saturated
        self.command(wire.SpeedCommand(value))

    def set_steering(self, value: int) -> None:
        """Send the PWM of the steering servo in µs, 0 … 65535.

        Raises:
            Refused: it is out of range, or cannot be sent now.
        """
        self.command(wire.SteeringCommand(value))

    def set_led(self, text: str) -> None:
        """Send an LED command: left, right, brake, disable …; at most 30 ASCII characters.

        Raises:
            Refused: it is too long or not ASCII, or cannot be sent now.
        """
        self.command(wire.LedCommand(text))

    def calibrate_imu(self) -> None:
        """Send IMU_CALIBRATION, and SPEED 0 before it if the car moves.

        Commands are refused until the calibration is over (see `Calibration`): the board would
        read them minutes later, all at once.

        Raises:
            Refused: it cannot be sent now.
        """
        self.command(wire.ImuCalibration())
        if self._on_calibrating:
            self._on_calibrating(True)

    def command(self, message: LayoutMessage) -> None:
        """Send any message to the board at once.

        Raises:
            Refused: a value is out of range, or the message cannot be sent now.
        """
        try:
            reason = message.implausible()
            if reason:
                raise ValueError(reason)
            wire.encode(message)     # before any log line below quotes a text that is too long
        except ValueError as error:
            too_long = len(getattr(message, 'text', '')) > wire.LED_LIMIT
            raise Refused(f'{message.LABEL} refused: {error}',
                          'too long' if too_long else 'value') from None
        with self._send_lock:
            now = clock()
            self._check_for_stall(now)
            self._refuse_if_not_ready(message, now)
            calibration = isinstance(message, wire.ImuCalibration)
            try:
                if calibration and self._motor.moving:
                    self._send_packet(_SPEED_0, now)
                self._send_packet(message, now)
            except (PortBusy, PortError) as error:
                # The heartbeat thread drops the blocked output before anything else is sent.
                busy = isinstance(error, PortBusy)
                raise Refused(f'{message} refused: {error}', 'busy' if busy else 'port') from None
            if calibration:
                self._calibration = Calibration(self.settings.calibration_timeout, now)

    def _refuse_if_not_ready(self, message: LayoutMessage, now: float) -> None:
        if self._stopped:
            raise Refused(f'{message} refused: the bridge is stopping', 'stopping')
        if message.ANNOUNCED:       # with the lock held, which `closed` takes before a next opening
            self.announcement.refuse_unless_current(f'{message}')
        if self.calibrating:
            raise Refused(f'{message} refused: the board calibrates its IMU, '
                          'which takes minutes', 'calibrating')
        # A call counts as from a stall sooner than a topic's command, as on the bus.
        if self._motor.ignores_commands(now) or (
                isinstance(message, wire.ImuCalibration) and self.connection.may_be_from_a_stall()):
            raise Refused(f'{message} refused: it may have waited while the bridge stalled; '
                          'send it again', 'stall')
        if self._held:
            raise Refused(f'{message} refused: the board is silent, so the other side of the '
                          'pseudo terminal may hold it back', 'silent')
        if self.port.backlog() > _MOST_BACKLOG:
            raise Refused(f'{message} refused: the port takes no data', 'busy')

    # -- sending: the caller holds the lock -----------------------------------------------

    def _send_packet(self, message: LayoutMessage, now: float) -> None:
        """Write one packet, and SPEED 0 before it while the board's speed is unknown.

        Raises:
            PortBusy, PortError: the packet was not sent, but SPEED 0 may have been.
        """
        if self._motor.speed_unknown and message != _SPEED_0:
            self._send_packet(_SPEED_0, now)
        if message is _HEARTBEAT and not (self.tap or self._cut_off):
            # A shortcut for the most frequent packet while no `tap` gets it.
            self.port.write(_HEARTBEAT_PACKET)
            self.frames_sent += 1
            return
        data = message.pack()
        packet = wire.encode_raw(message.TYPE, data)
        # After a packet that was cut off, a 0x00 ends the part that the board has received.
        packet = b'\0' + packet if self._cut_off else packet
        self.port.write(packet)
        self._cut_off = False
        if isinstance(message, wire.SpeedCommand):
            self._motor.sent(message.value, now)    # before anything that may raise
        self.written(packet, message.TYPE, 0, data, message)

    def _check_for_stall(self, now: float) -> None:
        # If the link's thread stalls, so do the threads that receive commands: all have the same
        # priority.
        stalled_for = self._motor.detect_stall(now, self.connection.stalls.awake_at)
        if stalled_for is not None:
            self._log_later('stall', f'the bridge stalled for {stalled_for:.3g} s: SPEED 0 is sent '
                            'first, and commands from that time are dropped')

    def _drop_backlog(self) -> None:
        """Drop the output that waits in a blocked port, so that no old command reaches the
        board."""
        dropped = self._drop_output()
        self._log_later('blocked', 'the port takes no data: ' + (
            'the output that waited is dropped' if dropped else 'the connection is closed')
                        + ', and the board stops its motor')

    def _drop_output(self) -> bool:
        """Drop what was written but not sent; return whether the port is still usable."""
        self._motor.forget_speed()
        self._cut_off = True
        return self.port.discard_output()

    # -- the heartbeat --------------------------------------------------------------------

    def start(self) -> None:
        self._motor.awake(clock())
        super().start()
        self._heartbeat.start()

    def stop(self) -> None:
        """Send SPEED 0, and nothing after it."""
        self._heartbeat.stop(_LAST_STOP_TIME)
        with self._send_lock:
            self._stopped = True        # the heartbeat thread may outlive the wait for it
            try:
                if self.port.backlog() > _MOST_BACKLOG:
                    self._drop_backlog()
                self._send_packet(_SPEED_0, clock())
            except (PortBusy, PortError):
                pass     # closed or blocked: without heartbeats the board stops its motor
            except Exception:  # pylint: disable=broad-except
                self._log_later('fault', traceback.format_exc())
        self._wait_until_sent()
        super().stop()

    def _wait_until_sent(self) -> None:
        """Wait for the last SPEED 0 to leave: closing a port may drop its output."""
        deadline = time.monotonic() + _LAST_STOP_TIME
        while self.port.on_its_way() and time.monotonic() < deadline:
            time.sleep(0.002)

    def _send_what_is_due(self, heartbeat_due: bool) -> bool:
        """In the heartbeat thread: send SPEED 0 if it is due, then a heartbeat if it is due.

        Returns whether a heartbeat was sent.
        """
        with self._send_lock:
            now = clock()       # read with the lock held: the bridge may stall while it waits
            self._check_for_stall(now)
            self._motor.awake(now)
            if self._stopped or not self.port.is_open:
                return False
            try:
                if now >= self._check_backlog_at:
                    self._check_backlog_at = now + _BACKLOG_PERIOD
                    if self.port.backlog() > _MOST_BACKLOG:
                        self._drop_backlog()
                why = self._motor.due(now, self._board_reads(now))
                if why:
                    self._send_packet(_SPEED_0, now)
                if why is Stop.TIMED_OUT:
                    self._log_later('speed timeout', 'no speed command for '
                                    f'{self.settings.speed_timeout:g} s: sent SPEED 0')
                if heartbeat_due:
                    self._send_packet(_HEARTBEAT, now)
                return heartbeat_due
            except PortBusy:
                self._drop_backlog()    # so the next packet is SPEED 0, not a heartbeat
            except PortError:
                pass                    # the link's thread gets it, too, and handles it
            return False

    def _board_reads(self, now: float) -> bool:
        """Whether the board may read commands.

        It reads none while it calibrates. But if IMU data is still received, the line may have lost
        the request to calibrate and the SPEED 0 before it.
        """
        calibration = self._calibration
        return calibration is None or calibration.data_goes_on(now)

    def _log_later(self, cause: str, text: str,
                   log: Optional[Callable[[str, str], None]] = None) -> None:
        """Log in the link's thread: logging may block, but heartbeats and commands must not."""
        self._unlogged.append((log or self.log.warn, cause, text))
        self.wake()

    # -- hooks --------------------------------------------------------------------------

    def opened(self, now: float) -> None:
        self._heartbeat.port_opened(clock())
        if self._calibration:
            self._calibration.port_opened(clock())

    def closed(self, now: float) -> None:
        # Now, not when the port opens again: then any thread may be the first to write.
        with self._send_lock:
            if self._motor.moving and not self._stopped:
                self._log_later('moved', 'the port closed while the car may have been moving: '
                                         'SPEED 0 is sent first when it is open again')
            self._motor.forget_speed()
            self._cut_off = self._held = False
            self._heartbeat.port_closed()

    def stalled(self, seconds: float, now: float) -> None:
        if self._calibration:
            self._calibration.stalled(seconds, clock())

    def altered(self, now: float) -> None:
        with self._send_lock:
            self._motor.forget_speed()
            self._cut_off = True

    def received(self, frame: Frame, now: float) -> None:
        message = frame.message
        if isinstance(message, wire.Log):
            self._log_received(message, now)
            return
        if isinstance(message, Chunk):
            self.announcement.take(message)
            return
        if isinstance(message, wire.Imu) and self._calibration:
            self._end_calibration(self._calibration.imu_data(clock()))
        if self._on_message and not self.announcement.holds_back(message):
            self._on_message(message, frame.stamp)

    def tick(self, now: float) -> Optional[float]:
        self._log_now()
        self._check_calibration_timeout()
        if self._calibration:
            return None     # the board may be silent; `tick` runs every 0.1 s in any case
        self._check_pty(now)
        try:
            return self.connection.check_silence(now, self.settings.network_silence)
        except PortError:
            self._append_speed_0()
            raise

    def _check_pty(self, now: float) -> None:
        """Hold commands back from a pseudo terminal while a board that has talked is silent.

        Its other side (socat, ser2net, a virtual machine) may stand, and send all of them later.
        What it can read already cannot be dropped, but has SPEED 0 behind it then. Heartbeats go
        on: the board may read.
        """
        limit = self.settings.network_silence
        held = self.port.is_pty and 0 < limit <= self.connection.silent_for(now)
        if held == self._held:
            return
        with self._send_lock:
            self._drop_output()     # also when it talks again: the heartbeats that waited
            self._held = held
        if held:
            self.log.warn('silent', f'nothing received from the board for {limit:g} s: what was '
                          'written is dropped, SPEED 0 is sent, and commands are refused until '
                          'it talks')

    def idle(self, now: float) -> Optional[float]:
        self._log_now()
        self._check_calibration_timeout()
        return None

    def _log_now(self) -> None:
        """Log what other threads passed to `_log_later`."""
        while self._unlogged:
            log, cause, text = self._unlogged.popleft()
            log(cause, text)

    def _append_speed_0(self) -> None:
        """Send SPEED 0 behind the commands that wait in the network, which cannot be dropped."""
        with self._send_lock:
            try:
                self._send_packet(_SPEED_0, clock())
            except (PortBusy, PortError):
                pass

    def _check_calibration_timeout(self) -> None:
        if self._calibration:
            self._end_calibration(self._calibration.check_timeout(clock()))

    def _end_calibration(self, end: Optional[End]) -> None:
        """End the calibration for this reason; None: it is not over."""
        if end is None:
            return
        self._calibration = None
        if end is End.BACK:
            self.log.info('calibrated', end.value)
        else:
            self.log.warn('not calibrated', end.value.format(self.settings.calibration_timeout))
        if self._on_calibrating:
            self._on_calibrating(False)

    def _log_received(self, message: wire.Log, now: float) -> None:
        if not self._board_lines.take(now):
            self.log.warn('chatter', 'the board logs too much (over {} lines at once or {:g} a '
                          'second): some lines are left out'.format(*_BOARD_LINES))
            return
        if self._on_log:
            self._on_log(message.severity, message.text)

    def talks(self, now: float) -> Optional[bool]:
        return None if self.calibrating else super().talks(now)     # then it is silent for minutes

    def report(self, now: float) -> Report:
        self._recent_gap = self._heartbeat.recent_gap(clock())
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

    def extra_values(self) -> List[Tuple[str, Any]]:
        return [('heartbeats sent', self.heartbeats_sent),
                ('heartbeat gap [ms]', f'{self._recent_gap * 1e3:.2f}'),
                ('heartbeat max gap [ms]', f'{self._heartbeat.max_gap * 1e3:.2f}')]
