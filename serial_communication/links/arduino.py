"""The link to the model car: commands down, measurements up, and the heartbeat that keeps the
motor alive. What may reach the motor, and when, is decided here and nowhere else."""
import os
import struct
import threading
import time
from collections import deque
from typing import Any, Callable, Deque, List, NamedTuple, Optional, Tuple

from ..protocols import arduino
from ..protocols.framing import Frame
from .link import OK, WARN, Link, Refused
from .port import Port, PortBusy, PortError

_LONGEST_NAP = 0.02      # s; so that a slow heartbeat does not make SPEED 0 late
_STALLED = 0.05          # s of wire time that wait in the kernel: the port does not flow
_CALIBRATION_ECHO = 1.0  # s after IMU_CALIBRATION in which IMU packets may still be old ones
_LAST_WORD = 0.1         # s that SPEED 0 has to leave the port at the end
_HEARTBEAT = arduino.encode(arduino.Heartbeat())
_BEATS_A_LOOK = 10       # heartbeats from one look at what waits in the kernel to the next
_REALTIME_PRIORITY = 20
_BOARD_LINES = 100       # log lines of the board's in a burst …
_BOARD_LINE_RATE = 10.0  # … and a second after that


class ArduinoSettings(NamedTuple):
    """Parameters of the session, in seconds where they are times."""

    heartbeat_rate: float = 100.0        # Hz
    speed_timeout: float = 0.5           # 0: never
    calibration_timeout: float = 900.0   # a calibration without an end is over after this
    check_plausibility: bool = True


class ArduinoLink(Link):
    """Commands from any thread; they reach an open port at once or are refused.

    Args:
        on_message: is called in the link's thread with each (message, stamp) but the logs.
        on_log: likewise with each (severity 0 … 3, text), sparingly if they are many.
        on_calibrating: is called with True and False as a calibration begins and ends.
    """

    def __init__(self, port: Port, settings: ArduinoSettings = ArduinoSettings(),
                 on_message: Optional[Callable[[Any, Any], None]] = None,
                 on_log: Optional[Callable[[int, str], None]] = None,
                 on_calibrating: Optional[Callable[[bool], None]] = None,
                 **link_arguments) -> None:
        super().__init__('arduino', port, arduino.Decoder(settings.check_plausibility),
                         **link_arguments)
        self.settings = settings
        self.calibrating = False
        self.heartbeats_sent = 0
        self.heartbeat_max_gap = 0.0     # s, since the port opened
        self._on_message = on_message
        self._on_log = on_log
        self._on_calibrating = on_calibrating
        self._commands = threading.Lock()    # one command at a time, and the state below
        self._moving = False                 # the last speed that left was not 0
        self._speed_due = 0.0                # when SPEED 0 follows by itself, if moving
        self._calibrating_since = 0.0
        self._finished = False               # SPEED 0 was the last word
        self._cut_off = False                # the latest packet may have left in part
        self._unsaid: Deque[Tuple[str, str]] = deque()
        self._open = threading.Event()
        self._heart_stopping = threading.Event()
        self._heart = threading.Thread(target=self.lasting(self._beat),
                                       name='arduino heartbeat', daemon=True)
        self._board_lines = float(_BOARD_LINES)
        self._board_line_at = 0.0

    # -- commands -----------------------------------------------------------------------

    def set_speed(self, value: int) -> None:
        """PWM of the drive motor, saturated to ±1000; Refused where it cannot be sent now."""
        limit = arduino.SPEED_LIMIT
        if not -limit <= value <= limit:
            self.log.warn('saturated', 'speed %d is beyond %d either way; sent as that'
                          % (value, limit))
            value = limit if value > 0 else -limit
        with self._commands:
            self._command(arduino.SpeedCommand(value))
            self._moving = value != 0
            self._speed_due = time.monotonic() + self.settings.speed_timeout

    def set_steering(self, value: int) -> None:
        """PWM of the steering servo in µs, 0 … 65535; Refused where it cannot be sent now."""
        with self._commands:
            self._command(arduino.SteeringCommand(value))

    def set_led(self, text: str) -> None:
        """left, right, brake, disable …; Refused also if it is too long or not ASCII."""
        with self._commands:
            self._command(arduino.LedCommand(text))

    def calibrate_imu(self) -> None:
        """Send IMU_CALIBRATION, after SPEED 0 if the car moves; Refused if it cannot be sent.

        From then on commands are refused until IMU data returns: the board would read them
        minutes later, all at once.
        """
        with self._commands:
            if self._moving:
                self._command(arduino.SpeedCommand(0))
                self._moving = False
            self._command(arduino.ImuCalibration())
            self._calibrating_since = time.monotonic()
            self.calibrating = True
        self.wake()
        if self._on_calibrating:
            self._on_calibrating(True)

    def _command(self, message: Any) -> None:
        if self._finished:
            raise Refused(f'{message} refused: the bridge is stopping', 'stopping')
        if self.calibrating:
            raise Refused(f'{message} refused: the IMU is being calibrated, '
                          'which takes minutes', 'calibrating')
        try:
            message.pack()
        except (ValueError, struct.error) as error:
            too_long = len(getattr(message, 'text', '')) > arduino.LED_LIMIT
            raise Refused('refused: %s' % error, 'too long' if too_long else 'value') from None
        if self.port.backlog() > _STALLED:
            raise Refused(f'{message} refused: the port takes no data', 'busy')
        try:
            self._send(message)
        except (PortBusy, PortError) as error:
            busy = isinstance(error, PortBusy)
            if busy:
                self._unblock()
            raise Refused(f'{message} refused: {error}', 'busy' if busy else 'port') from None

    def _send(self, message: Any) -> None:
        data = message.pack()
        packet = arduino.encode_raw(message.TYPE, data)
        # After a packet that was cut off, a 0x00 first: it ends what the board has of it.
        self.send(b'\0' + packet if self._cut_off else packet, message.TYPE, 0, data, message)
        self._cut_off = False

    def _unblock(self) -> None:
        """The port does not flow: drop what waits, or it reaches the board late, commands too."""
        self.port.discard_output()
        self._cut_off = True
        self._say_later('stalled', 'the port takes no data; what waited was dropped, '
                                   'the board stops its motor')

    # -- the heartbeat ------------------------------------------------------------------

    def start(self) -> None:
        super().start()
        self._heart.start()

    def stop(self) -> None:
        """SPEED 0, then silence."""
        self._heart_stopping.set()
        self._open.set()
        if self._heart.is_alive():
            self._heart.join(_LAST_WORD)     # so that no heartbeat follows the last word
        with self._commands:
            self._finished = True
            try:
                if self.port.backlog() > _STALLED:
                    self._unblock()
                self._send(arduino.SpeedCommand(0))
            except (PortBusy, PortError):
                pass     # closed, or stuck: without heartbeats the board stops by itself
        self._let_out()
        super().stop()

    def _let_out(self) -> None:
        """Closing a port may drop what it has not sent yet: give the last word its time."""
        deadline = time.monotonic() + _LAST_WORD
        while self.port.backlog() > 0 and time.monotonic() < deadline:
            time.sleep(0.002)

    def _beat(self) -> None:
        """Absolute deadlines of the monotonic clock; after a stall no burst."""
        _be_quick()
        period = 1.0 / self.settings.heartbeat_rate
        while not self._heart_stopping.is_set():
            self._open.wait()
            last = None
            due = time.monotonic()
            while self._open.is_set() and not self._heart_stopping.is_set():
                now = time.monotonic()
                if now >= due:
                    if self._heartbeat():
                        if last is not None:
                            self.heartbeat_max_gap = max(self.heartbeat_max_gap, now - last)
                        last = now
                    due += period
                    if due < now:
                        due = now + period
                if self._moving and self.settings.speed_timeout and now >= self._speed_due:
                    self._stop_motor(now)
                time.sleep(max(0.0, min(due - time.monotonic(), _LONGEST_NAP)))

    def _heartbeat(self) -> bool:
        # The same three bytes every time, and few lines: this runs a hundred times a second.
        try:
            if self.heartbeats_sent % _BEATS_A_LOOK == 0 and self.port.backlog() > _STALLED:
                self._unblock()
            if self.tap or self._cut_off:
                self._send(arduino.Heartbeat())
            else:
                self.port.write(_HEARTBEAT)
                self.frames_sent += 1
        except PortBusy:
            self._unblock()
            return False
        except PortError:
            return False
        self.heartbeats_sent += 1
        return True

    def _stop_motor(self, now: float) -> None:
        with self._commands:
            if not self._moving or now < self._speed_due or self._finished:
                return      # a command came meanwhile
            try:
                self._send(arduino.SpeedCommand(0))
            except (PortBusy, PortError):
                return      # tried again in a moment
            self._moving = False
        self._say_later('speed timeout', 'no speed command for %g s: SPEED 0 sent'
                        % self.settings.speed_timeout)

    def _say_later(self, cause: str, text: str) -> None:
        """Have the link's thread log it: a log may block, a heartbeat and a command may not."""
        self._unsaid.append((cause, text))
        self.wake()

    # -- hooks --------------------------------------------------------------------------

    def opened(self, now: float) -> None:
        self.heartbeat_max_gap = 0.0
        self._cut_off = False
        with self._commands:
            # The board may still hold the speed it had before: not to be woken by a heartbeat.
            self._speed_due = now
            if self._moving and not self._finished:
                try:
                    self._send(arduino.SpeedCommand(0))
                    self._moving = False
                    self._say_later('moved', 'the car was moving when the port went: SPEED 0 sent')
                except PortBusy:
                    pass    # the heartbeat's thread tries again
        self._open.set()

    def closed(self, now: float) -> None:
        if not self._heart_stopping.is_set():
            self._open.clear()

    def received(self, frame: Frame, now: float) -> None:
        message = frame.message
        if isinstance(message, arduino.Log):
            self._board_says(message, now)
            return
        if self.calibrating and isinstance(message, arduino.Imu) \
                and now > self._calibrating_since + _CALIBRATION_ECHO:
            self._calibrated('IMU data is back: the calibration is over')
        if self._on_message:
            self._on_message(message, frame.stamp)

    def tick(self, now: float) -> Optional[float]:
        while self._unsaid:
            self.log.warn(*self._unsaid.popleft())
        if not self.calibrating:
            return None
        due = self._calibrating_since + self.settings.calibration_timeout
        if now < due:
            return due
        self._calibrated('no IMU data %g s after the calibration began; taking commands again'
                         % self.settings.calibration_timeout)
        return None

    def idle(self, now: float) -> Optional[float]:
        return self.tick(now)

    def _calibrated(self, why: str) -> None:
        self.calibrating = False
        self.log.info('calibrated', why)
        if self._on_calibrating:
            self._on_calibrating(False)

    def _board_says(self, message: arduino.Log, now: float) -> None:
        self._board_lines = min(_BOARD_LINES, self._board_lines
                                + (now - self._board_line_at) * _BOARD_LINE_RATE)
        self._board_line_at = now
        if self._board_lines < 1:
            self.log.warn('chatter', 'the board logs too much; lines of it are left out')
            return
        self._board_lines -= 1
        if self._on_log:
            self._on_log(message.severity, message.text)

    def condition(self, now: float) -> Tuple[int, str]:
        level, summary = super().condition(now)
        if self.calibrating and self.port.is_open:
            return WARN if level else OK, 'calibrating the IMU'
        return level, summary

    def own_values(self) -> List[Tuple[str, Any]]:
        return [('heartbeats sent', self.heartbeats_sent),
                ('heartbeat max gap [ms]', '%.2f' % (self.heartbeat_max_gap * 1e3))]


def _be_quick() -> None:
    """Real-time priority for this thread where the system allows it."""
    try:
        os.sched_setscheduler(threading.get_native_id(), os.SCHED_FIFO,
                              os.sched_param(_REALTIME_PRIORITY))
    except (OSError, AttributeError):
        pass
