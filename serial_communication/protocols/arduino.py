"""The model car's packets: one message type byte and its data, COBS-encoded, ended by 0x00.

    +-------------------- COBS --------------------+
    | message type (1 byte) | data (0 … 255 bytes) |   0x00
    +----------------------------------------------+

Both sides talk at any time. There is no checksum, so values that cannot be are refused too.
Little-endian but for the IMU, which is big-endian. A message is one class here: its type, its
layout, its limits. Decisions where the source is silent: see "Protocols" in README.md.
"""
from math import isfinite, pi
from struct import Struct
from typing import Any, Dict, List, NamedTuple, Tuple
from unicodedata import category

from . import cobs
from .framing import (FRAMING, IMPLAUSIBLE, LENGTH, OVERSIZE, UNKNOWN, Frame, bad_frame,
                      good_frame)

MAX_PACKET = 256                        # type and data, decoded
_MAX_ENCODED = MAX_PACKET + 2           # the same in COBS
SPEED_LIMIT = 1000                      # PWM, either direction
LED_LIMIT = 30                          # characters
GYRO_SCALE = 4000 / 65536 * pi / 180 * 25   # rad/s per LSB, found by experiment
_QUATERNION = 1 / 16384
_ACCELERATION = 8 / 65536 * 9.81        # m/s² per LSB
_UNIT_SQUARED = 16384 ** 2
_LEAST_SQUARED = 0.95 ** 2 * _UNIT_SQUARED    # of a quaternion that can be
_MOST_SQUARED = 1.05 ** 2 * _UNIT_SQUARED

_new = tuple.__new__                    # a NamedTuple without its constructor

Vector = Tuple[float, float, float]


def _layout(type_: int, layout: str):
    """Give a message class its type and the packing of its fields as they stand."""
    def add(cls):
        struct = Struct(layout)
        cls.TYPE = type_
        cls.SIZE = struct.size
        cls.pack = lambda self: struct.pack(*self)
        cls.unpack = classmethod(lambda c, data: _new(c, struct.unpack(data)))
        cls.implausible = getattr(cls, 'implausible', None)
        return cls
    return add


def _readable(text: str) -> str:
    """One line that harms no terminal."""
    return ''.join(c if c.isprintable() or category(c) == 'Zs' else '\N{REPLACEMENT CHARACTER}'
                   for c in text)


class Log(NamedTuple):
    """DEBUG, INFO, WARN, ERROR (0 … 3), board -> us: a line for people."""

    TYPES = (0, 1, 2, 3)
    SIZE = None

    severity: int
    text: str      # control characters and bad UTF-8 replaced

    @classmethod
    def unpack(cls, severity: int, data: bytes) -> 'Log':
        """From the data, usually ended by 0x00."""
        text = data.split(b'\0', 1)[0].decode('utf-8', 'replace')
        return cls(severity, _readable(text.rstrip('\r\n')))

    @property
    def TYPE(self) -> int:  # noqa: N802 - the type is the severity
        return self.severity

    def pack(self) -> bytes:
        return self.text.encode() + b'\0'

    def __str__(self) -> str:
        return '%s: %s' % (('DEBUG', 'INFO', 'WARN', 'ERROR')[self.severity], self.text)


@_layout(4, '<h')
class SpeedCommand(NamedTuple):
    """SPEED_CMD, us -> board: PWM of the drive motor, -1000 … 1000."""

    value: int

    def __str__(self) -> str:
        return 'speed %d' % self.value


@_layout(5, '<H')
class SteeringCommand(NamedTuple):
    """STEERING_CMD, us -> board: PWM of the steering servo, µs."""

    value: int

    def __str__(self) -> str:
        return 'steering %d' % self.value


class LedCommand(NamedTuple):
    """LED_CMD, us -> board: left, right, brake, disable …: at most 30 characters of ASCII."""

    TYPE = 6
    SIZE = None
    implausible = None

    text: str

    @classmethod
    def unpack(cls, data: bytes) -> 'LedCommand':
        """From the data, a text and a 0x00."""
        return cls(data.split(b'\0', 1)[0].decode('ascii', 'replace'))

    def pack(self) -> bytes:
        """The data.

        Raises:
            ValueError: too long, not ASCII, or with the NUL that would end it early.
        """
        if len(self.text) > LED_LIMIT:
            raise ValueError('LED text is %d characters long, may be at most %d'
                             % (len(self.text), LED_LIMIT))
        if not self.text.isascii() or '\0' in self.text:
            raise ValueError('LED text %r must be ASCII, without a NUL' % self.text)
        return self.text.encode('ascii') + b'\0'

    def __str__(self) -> str:
        return 'LED %s' % _readable(self.text)


@_layout(7, '<H')
class SteeringAngle(NamedTuple):
    """STEERING_ANGLE, board -> us: raw servo feedback, 0 … 1024."""

    value: int

    def implausible(self) -> str:
        return 'steering angle %d is over 1024' % self.value if self.value > 1024 else ''

    def __str__(self) -> str:
        return 'steering angle %d' % self.value


@_layout(8, '<B')
class Ticks(NamedTuple):
    """TICKS, board -> us: encoder ticks in the last 0.01 s."""

    value: int

    def __str__(self) -> str:
        return 'ticks %d' % self.value


@_layout(9, '>11h')
class Imu(NamedTuple):
    """IMU, board -> us: the motion processor's numbers, in its own axes and units.

    The methods give SI units in ROS's axes: x = board y, y = -board x, z = board z.
    """

    qw: int
    qx: int
    qy: int
    qz: int
    gx: int
    gy: int
    gz: int
    ax: int
    ay: int
    az: int
    raw_temperature: int

    @classmethod
    def from_si(cls, orientation, angular_velocity: Vector, linear_acceleration: Vector,
                temperature: float, gyro_scale: float = GYRO_SCALE) -> 'Imu':
        """What a board sends for these values; the methods' inverse, saturated to int16."""
        x, y, z, w = orientation
        gx, gy, gz = angular_velocity
        ax, ay, az = linear_acceleration
        scaled = [part / scale for scale, parts in (
            (_QUATERNION, (w, -y, x, z)), (gyro_scale, (-gy, gx, gz)),
            (_ACCELERATION, (-ay, ax, az)), (1 / 340, (temperature - 36.53,))) for part in parts]
        return cls(*(min(max(round(value), -0x8000), 0x7FFF) for value in scaled))

    def orientation(self) -> Tuple[float, float, float, float]:
        """Quaternion x, y, z, w."""
        return (self.qy * _QUATERNION, -self.qx * _QUATERNION, self.qz * _QUATERNION,
                self.qw * _QUATERNION)

    def angular_velocity(self, gyro_scale: float = GYRO_SCALE) -> Vector:
        """x, y, z in rad/s."""
        return self.gy * gyro_scale, -self.gx * gyro_scale, self.gz * gyro_scale

    def linear_acceleration(self) -> Vector:
        """x, y, z in m/s²."""
        return self.ay * _ACCELERATION, -self.ax * _ACCELERATION, self.az * _ACCELERATION

    def temperature(self) -> float:
        """In °C."""
        return self.raw_temperature / 340 + 36.53

    def implausible(self) -> str:
        qw, qx, qy, qz = self[:4]
        square = qw * qw + qx * qx + qy * qy + qz * qz
        if _LEAST_SQUARED <= square <= _MOST_SQUARED:
            return ''
        return 'norm of the quaternion is %.3f' % (square / _UNIT_SQUARED) ** 0.5

    def __str__(self) -> str:
        return 'IMU q (%.3f %.3f %.3f %.3f) a (%.2f %.2f %.2f) m/s^2' % (
            self.orientation() + self.linear_acceleration())


@_layout(10, '<f')
class Voltage(NamedTuple):
    """VOLTAGE, board -> us: battery volts, averaged over 3 s."""

    value: float

    def implausible(self) -> str:
        if isfinite(self.value) and 0 <= self.value <= 100:
            return ''
        return '%g V is not within 0 to 100' % self.value

    def __str__(self) -> str:
        return 'voltage %.2f V' % self.value


@_layout(11, '')
class Heartbeat(NamedTuple):
    """HEARTBEAT, us -> board. The board stops the motor when none comes for 30 ms."""

    def __str__(self) -> str:
        return 'heartbeat'


@_layout(12, '')
class ImuCalibration(NamedTuple):
    """IMU_CALIBRATION, us -> board: it calibrates for over 5 minutes, deaf meanwhile."""

    def __str__(self) -> str:
        return 'calibrate the IMU'


_FROM_BOARD = (SteeringAngle, Ticks, Imu, Voltage)
_TO_BOARD = (SpeedCommand, SteeringCommand, LedCommand, Heartbeat, ImuCalibration)


def encode(message: Any) -> bytes:
    """The packet on the wire, its ending 0x00 included.

    Raises:
        ValueError: a text that the message does not allow, or too long a packet.
        struct.error: a number outside its type.
    """
    return encode_raw(message.TYPE, message.pack())


def encode_raw(type_: int, data: bytes) -> bytes:
    """A packet of any type; ValueError where it is over `MAX_PACKET` bytes."""
    if len(data) >= MAX_PACKET:
        raise ValueError('a packet holds at most %d bytes of data' % (MAX_PACKET - 1))
    return cobs.encode(bytes((type_,)) + data) + b'\0'


class _Decoder:
    """Packets ended by 0x00. The next packet after a bad one begins behind its 0x00."""

    front = needed = 0    # of a pending packet nothing is known until its 0x00 …
    _messages: Dict[int, Any] = {}

    def __init__(self, check_plausibility: bool = True) -> None:
        self.errors = dict.fromkeys((FRAMING, OVERSIZE, LENGTH, UNKNOWN, IMPLAUSIBLE), 0)
        self._check = check_plausibility
        self.reset()

    @property
    def pending(self) -> bool:
        """Whether a packet has begun and has not ended."""
        return bool(self._begun) or self._dropping

    def reset(self) -> None:
        """Forget what is pending, as after a reconnect; the counts stay."""
        self._begun = b''
        self._dropping = False     # the rest of a packet that is too long already

    def feed(self, data: bytes, stamp: Any = None) -> List[Frame]:
        """Take bytes as they were read; return the packets, good and bad, now complete."""
        frames: List[Frame] = []
        packets = (self._begun + data).split(b'\0')
        self._begun = packets.pop()
        for packet in packets:
            if self._dropping:
                self._dropping = False
            elif len(packet) > _MAX_ENCODED:
                self._oversize(packet, frames, stamp)
            elif packet:
                frames.append(self._packet(packet, stamp))
        if len(self._begun) > _MAX_ENCODED or self._dropping:
            if not self._dropping:
                self._oversize(self._begun, frames, stamp)
                self._dropping = True
            self._begun = b''
        return frames

    def give_up(self) -> List[Frame]:
        """The packet that has begun stays incomplete: drop it."""
        frames: List[Frame] = []
        if self._begun:
            self.errors[FRAMING] += 1
            frames.append(bad_frame(self._begun, FRAMING, 'a packet cut short'))
        self.reset()
        return frames

    def doubt(self) -> List[Frame]:
        """… so no packet is held back by another one."""
        return []

    def _oversize(self, packet: bytes, frames: List[Frame], stamp: Any) -> None:
        self.errors[OVERSIZE] += 1
        frames.append(bad_frame(packet, OVERSIZE,
                                'a packet of over %d bytes' % MAX_PACKET, stamp))

    def _packet(self, encoded: bytes, stamp: Any) -> Frame:
        raw = encoded + b'\0'
        packet = cobs.undo(encoded)
        if packet is None:
            return self._bad(raw, FRAMING, 'a code runs past the end', stamp)
        if not packet:
            return self._bad(raw, FRAMING, 'a packet without a type', stamp)
        if len(packet) > MAX_PACKET:
            return self._bad(raw, OVERSIZE, 'a packet of %d bytes' % len(packet), stamp)
        type_, data = packet[0], packet[1:]
        message_class = self._messages.get(type_)
        if message_class is None:
            return self._bad(raw, UNKNOWN, 'message type %d is not known here' % type_,
                             stamp, type_, data)
        if message_class is Log:
            return good_frame(raw, type_, 0, data, Log.unpack(type_, data), stamp)
        if message_class.SIZE != len(data) and message_class.SIZE is not None:
            return self._bad(raw, LENGTH, 'a %s has %d bytes of data, not %d' % (
                message_class.__name__, message_class.SIZE, len(data)), stamp, type_, data)
        message = message_class.unpack(data)
        if self._check:
            reason = message.implausible and message.implausible()
            if reason:
                return self._bad(raw, IMPLAUSIBLE, reason, stamp, type_, data)
        return good_frame(raw, type_, 0, data, message, stamp)

    def _bad(self, raw, cause, error, stamp, type_=0, data=b'') -> Frame:
        self.errors[cause] += 1
        return bad_frame(raw, cause, error, stamp, type_, data)


class Decoder(_Decoder):
    """Board -> us."""

    _messages = {message.TYPE: message for message in _FROM_BOARD}
    _messages.update(dict.fromkeys(Log.TYPES, Log))


class BoardDecoder(_Decoder):
    """Us -> board, for simulated boards."""

    _messages = {message.TYPE: message for message in _TO_BOARD}
