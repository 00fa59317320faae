"""The simulated model car: motor, servo, LEDs, encoder, motion sensor and battery of one Nano.

    motor      SPEED ±1000 is ±2.5 m/s at full charge, reached with a time constant of 0.25 s;
               off when no heartbeat is received for 30 ms, until the next SPEED that follows a
               heartbeat within 30 ms; while it is off, the car rolls out
    encoder    400 ticks a metre, either way; TICKS every 10 ms
    servo      1000 … 2000 µs, 1500 is straight on, more is right; 0.3 s from end to end; feedback
               512 ± 300, more is right; STEERING_ANGLE every 10 ms
    car        wheelbase 0.26 m, wheels turn by up to 25°
    IMU        every 10 ms: orientation, rates and accelerations (with gravity) of the motion
    battery    8.2 V, sags by up to 0.6 V under load; VOLTAGE every second, averaged over 3 s
    LEDs       left, right, brake, hazard, disable

After IMU_CALIBRATION the board reads nothing and sends no IMU data for `calibration_time`: 10 s,
short enough to watch; a real board takes over five minutes. As on a real Nano, a receive buffer
keeps the first 64 bytes of that time, and the rest is lost. The board reads them afterwards, all at
once.
"""
import argparse
import math
from collections import deque
from random import Random
from typing import Any, Deque, Optional, Sequence

from ...framing.layout import LayoutMessage
from ...framing.rotation import quaternion
from ...framing.rows import Kind, Row, Setting
from ...framing.stream import SETTING, Frame
from ...simulation.board import Board, positive
from ...simulation.custom_messages import CustomMessagePlayer
from ...transport.pace import Every
from . import DESCRIPTION, wire

HEARTBEAT_TIMEOUT = 0.03   # s
PERIOD = 0.01              # s between two measurements
RECEIVE_BUFFER = 64        # bytes
TOP_SPEED = 2.5            # m/s
MOTOR_LAG = 0.25           # s
TICKS_PER_METRE = 400
SERVO_MIN, SERVO_CENTRE, SERVO_MAX = 1000, 1500, 2000   # µs
SERVO_RATE = 1000 / 0.3    # µs/s
FEEDBACK_CENTRE, FEEDBACK_SPAN = 512, 300               # raw, at the centre and from there
WHEELBASE = 0.26           # m
STEERING_LOCK = math.radians(25)
BATTERY, SAG, DISCHARGE = 8.2, 0.6, 0.0005   # V; V at full load; V/s at full load
G = 9.81

_INFO, _WARN = 1, 2        # severities
_LEDS = ('left', 'right', 'brake', 'hazard', 'disable')


class ModelCar(Board):
    """See the module. Positive is forward, left, and counter-clockwise.

    Args:
        calibration_time: s.
        seed: seed of the sensors' noise.
        custom: custom messages: those from the board are sent, those to it are shown.
        announcement: the text to announce; None: nothing.
        settings: that the board has.
        period: s between two measurements.
    """

    decoder: wire.BoardDecoder
    NAME = DESCRIPTION.name
    SUMMARY = 'model car: motor, servo, encoder, IMU, battery'
    FAULTS = ('drop=0.001 cut=0.001 lose=0.001 flip=0.001 insert=0.001 double=0.001 delay=0.0003 '
              'rx-drop=0.001 rx-lose=0.001 rx-flip=0.001 rx-insert=0.001 '
              'silence=0.5/min stall=0.5/min reset=0.5/min')
    HAS_CLOCK = True
    MEASURES_PACE = True
    CHATTER = b'\x14\x10avrboot\r\n\xff\x1c\xe0'

    @classmethod
    def add_options(cls, parser: argparse.ArgumentParser) -> None:
        parser.add_argument('--calibration-time', type=positive, default=10.0, metavar='S',
                            help='how long an IMU calibration takes (%(default)g; a real board: '
                                 'over 300)')

    @classmethod
    def from_options(cls, options: argparse.Namespace) -> 'ModelCar':
        return cls(options.calibration_time, options.seed, options.config,
                   options.announcement, options.config.settings)

    def __init__(self, calibration_time: float = 10.0, seed: int = 0,
                 custom: Sequence[Row] = (),
                 announcement: Optional[bytes] = None, settings: Sequence[Setting] = (),
                 period: float = PERIOD) -> None:
        self._custom = CustomMessagePlayer(custom, announcement, settings)
        super().__init__(wire.BoardDecoder(messages=[
            *(row.message for row in settings),
            *(row.message for row in custom if row.kind is Kind.TO)]))
        self.motor_on = False
        self.command = 0           # the SPEED at which the motor runs; 0 if it is off
        self.velocity = 0.0        # m/s
        self.distance = 0.0        # m that the wheels have turned, either way
        self.steering = float(SERVO_CENTRE)   # µs; position of the servo
        self.yaw = 0.0             # rad
        self.led = 'disable'
        self.calibrating = False
        self._calibration_time = calibration_time
        self._calibrated_at = 0.0
        self._kept = b''           # in the receive buffer while calibrating
        self._heartbeat = -math.inf    # time of the latest
        self._servo_target = float(SERVO_CENTRE)
        self._now = 0.0            # time of the computed motion
        self._acceleration = 0.0   # m/s², along the car
        self._counted = 0          # ticks sent so far
        self._charge = BATTERY
        self._volts: Deque[float] = deque(maxlen=300)   # of the last 3 s
        self._random = Random(f'{seed} car')
        self._period = period
        self._pace = Every(period, 0.0)
        self._second = Every(1.0, 0.0)

    # -- hooks ----------------------------------------------------------------------------

    def power_on(self, now: float) -> None:
        self._move(now)
        self.decoder.reset()
        self._heartbeat = -math.inf
        self.calibrating = False
        self._kept = b''
        self.led = 'disable'
        self._servo_target = float(SERVO_CENTRE)
        self._counted = int(self.distance * TICKS_PER_METRE)
        self._volts.clear()
        self._pace = Every(self._period, now)
        self._second = Every(1.0, now)
        self._custom.power_on(now)
        # A 0x00 ends the boot loader's output.
        self.line.send_raw(b'\0')
        self._log(_INFO, 'IMU ready')

    def power_off(self, now: float) -> None:
        self._move(now)
        self._motor_off('reset')

    def receive(self, data: bytes, now: float) -> None:
        self._move(now)
        if self.calibrating:
            self._kept = (self._kept + data)[:RECEIVE_BUFFER]
        else:
            super().receive(data, now)

    def frame(self, frame: Frame, now: float) -> None:
        message = frame.message      # None: it is invalid
        if isinstance(message, wire.Heartbeat):
            if now >= self._heartbeat + HEARTBEAT_TIMEOUT:
                self._custom.announce_often(now)
            self._heartbeat = now
        elif isinstance(message, wire.SpeedCommand):
            self._set_speed(message.value, now)
        elif isinstance(message, wire.SteeringCommand):
            self._servo_target = float(min(max(message.value, SERVO_MIN), SERVO_MAX))
        elif isinstance(message, wire.LedCommand):
            self._set_led(message.value)
        elif isinstance(message, wire.ImuCalibration):
            self._calibrate(now)
        elif frame.type == SETTING and not frame.cause:
            for answer in self._custom.use(message):
                self.line.say(str(answer))
                self._send(answer)
        elif isinstance(message, LayoutMessage):      # a custom message
            self.line.say(str(message))

    def advance(self, now: float) -> Optional[float]:
        self._move(now)
        if self.calibrating and now >= self._calibrated_at:
            self._calibration_over(now)
        if self._pace.passed(now):
            self._measure(now)
        if self._second.passed(now):
            self._send_measured(wire.Voltage(sum(self._volts) / len(self._volts)))
        self._send_measured(*self._custom.messages(now, self.line.micros()))
        for message in self._custom.announcements(now):
            self._send(message)
        due = min(self._pace.due, self._custom.due() or math.inf)
        if self.motor_on:
            due = min(due, self._heartbeat + HEARTBEAT_TIMEOUT)
        if self.calibrating:
            due = min(due, self._calibrated_at)
        return due

    # -- commands -------------------------------------------------------------------------

    def _set_speed(self, value: int, now: float) -> None:
        value = min(max(value, -wire.SPEED_LIMIT), wire.SPEED_LIMIT)
        if value == 0:
            self._motor_off('SPEED 0')
        elif now >= self._heartbeat + HEARTBEAT_TIMEOUT:
            self.line.note('motor', on=False, speed=0, why=f'SPEED {value} without a heartbeat')
        else:
            if not self.motor_on or self.command * value < 0:
                self.line.say(f'motor on: speed {value}')
            self.motor_on = True
            self.command = value
            self.line.note('motor', on=True, speed=value, why=f'SPEED {value}')

    def _motor_off(self, why: str) -> None:
        if self.motor_on:
            self.motor_on = False
            self.command = 0
            self.line.note('motor', on=False, speed=0, why=why)
            self.line.say(f'motor stopped: {why}')

    def _set_led(self, text: str) -> None:
        if text not in _LEDS:
            self._log(_WARN, 'unknown LED command')
            self.line.say(f'LED {text!r} is unknown')
        elif text != self.led:
            self.led = text
            self.line.say(f'LED: {text}')

    def _calibrate(self, now: float) -> None:
        self._motor_off('calibration')
        self._log(_INFO, 'IMU calibration: do not move the car')
        self.line.say(f'IMU calibration: reading nothing for {self._calibration_time:g} s')
        self.line.note('calibrate', on=True)
        self.calibrating = True
        self._calibrated_at = now + self._calibration_time

    def _calibration_over(self, now: float) -> None:
        kept, self._kept = self._kept, b''
        self.calibrating = False
        self.yaw = 0.0
        self.line.note('calibrate', on=False)
        self.line.say(f'IMU calibrated; reading the {len(kept)} bytes received meanwhile')
        self._log(_INFO, 'IMU calibrated, IMU ready')
        if kept:
            super().receive(kept, now)

    # -- the car ----------------------------------------------------------------------------

    def _move(self, now: float) -> None:
        """Compute the motion up to `now`, with the motor off from the heartbeat timeout on."""
        if self.motor_on:
            stop = self._heartbeat + HEARTBEAT_TIMEOUT
            if now >= stop:
                self._integrate(stop)
                self._motor_off('no heartbeat for 30 ms')
                self._log(_WARN, 'heartbeat lost, motor stopped')
        self._integrate(now)

    def _integrate(self, now: float) -> None:
        step = now - self._now
        if step <= 0:
            return
        self._now = now
        load = abs(self.command) / wire.SPEED_LIMIT
        target = TOP_SPEED * self.command / wire.SPEED_LIMIT
        before = self.velocity
        decay = math.exp(-step / MOTOR_LAG)
        self.velocity = target + (before - target) * decay
        if not self.motor_on and abs(self.velocity) < 0.002:
            self.velocity = 0.0     # friction stops it
        moved = target * step + (before - target) * MOTOR_LAG * (1 - decay)
        self.distance += abs(moved)
        self._acceleration = (self.velocity - before) / step
        self.yaw += moved * math.tan(self._wheel_angle()) / WHEELBASE
        self._charge -= DISCHARGE * load * step
        limit = SERVO_RATE * step
        self.steering += min(max(self._servo_target - self.steering, -limit), limit)

    def _wheel_angle(self) -> float:
        return (SERVO_CENTRE - self.steering) / (SERVO_MAX - SERVO_CENTRE) * STEERING_LOCK

    # -- measurements -------------------------------------------------------------------------

    def _measure(self, now: float) -> None:
        gauss = self._random.gauss
        ticks = int(self.distance * TICKS_PER_METRE)
        turned = (self.steering - SERVO_CENTRE) / (SERVO_MAX - SERVO_CENTRE)
        measured = [wire.Ticks(min(ticks - self._counted, 255)), wire.SteeringAngle(round(
            FEEDBACK_CENTRE + FEEDBACK_SPAN * turned + min(max(gauss(0, 0.6), -2), 2)))]
        self._counted = ticks
        load = abs(self.command) / wire.SPEED_LIMIT
        self._volts.append(self._charge - SAG * load + gauss(0, 0.01))
        if not self.calibrating:
            measured.append(self._imu(now))
        self._send_measured(*measured)

    def _imu(self, now: float) -> wire.Imu:
        gauss = self._random.gauss
        yaw_rate = self.velocity * math.tan(self._wheel_angle()) / WHEELBASE
        sideways = self.velocity * yaw_rate
        # The body leans to the outside of a curve, and backwards when the car accelerates.
        roll = 0.008 * sideways + gauss(0, 0.0005)
        pitch = -0.008 * self._acceleration + gauss(0, 0.0005)
        yaw = self.yaw + gauss(0, 0.0005)
        x, y, z, w = quaternion(roll, pitch, yaw)
        # In the board's axes: x is ROS's -y, y is its x.
        return wire.Imu.unpack(wire.Imu.LAYOUT.pack((
            w, -y, x, z, gauss(0, 0.02), gauss(0, 0.02), yaw_rate + gauss(0, 0.02),
            -sideways - G * math.sin(roll) + gauss(0, 0.04),
            self._acceleration - G * math.sin(pitch) + gauss(0, 0.04),
            G * math.cos(roll) * math.cos(pitch) + gauss(0, 0.04),
            31 + 2 * math.sin(now / 60) + gauss(0, 0.02))))

    def _log(self, severity: int, text: str) -> None:
        self._send(wire.LOGS[severity](text))

    def _send_measured(self, *messages: Any) -> None:
        """Send messages that hold what is measured now."""
        if messages and self.line.sends_time:
            self._send(wire.Time(self.line.micros(), len(messages)))
        for message in messages:
            self._send(message)

    def _send(self, message: Any) -> None:
        self.line.send(wire.encode(message))


BOARD = ModelCar
