"""The model car's packets: one message type byte and its data, COBS-encoded, ended by 0x00.

    +-------------------- COBS --------------------+
    | message type (1 byte) | data (0 … 255 bytes) |   0x00
    +----------------------------------------------+

Both sides send at any time. There is no checksum, so packets with impossible values are invalid.
Little-endian; only the IMU data is big-endian. Each message is one class with its type, layout and
limits. doc/protocols.md lists the decisions where the source says nothing.
"""
import struct
from collections import namedtuple
from math import pi
from typing import Any, Iterable, List, Tuple, Type

from ...framing import announcement, cobs, stream
from ...framing.layout import (BOARD_TIME, Layout, LayoutMessage, Value, brief,
                               message_class, readable)
from ...framing.rows import SettingMessage
from ...framing.stream import (FRAMING, IMPLAUSIBLE, LENGTH, OVERSIZE, SETTING, UNKNOWN, Frame,
                               by_type, invalid_frame)

MAX_PACKET = 256                        # type and data, decoded
_MAX_ENCODED = MAX_PACKET + 2           # the same, encoded
SPEED_LIMIT = 1000                      # PWM, in either direction
LED_LIMIT = 30                          # characters
GYRO_SCALE = 4000 / 65536 * pi / 180 * 25   # rad/s per LSB, found by experiment
_QUATERNION = 1 / 16384
_ACCELERATION = 8 / 65536 * 9.81        # m/s² per LSB
_LEAST_SQUARED, _MOST_SQUARED = (0.95 / _QUATERNION) ** 2, (1.05 / _QUATERNION) ** 2

Vector = Tuple[float, float, float]
Quaternion = Tuple[float, float, float, float]      # x, y, z, w


class Text(LayoutMessage, namedtuple('Text', 'value')):
    """A text, sent with a 0x00 at its end; control characters and bad UTF-8 are replaced."""

    __slots__ = ()
    LAYOUT = Layout('<s', [Value('value')])

    @classmethod
    def unpack(cls, data: bytes) -> 'Text':
        text = data.split(b'\0', 1)[0].decode('utf-8', 'replace')
        return tuple.__new__(cls, (readable(text.rstrip('\r\n')),))

    def pack(self) -> bytes:
        return super().pack() + b'\0'

    def implausible(self) -> str:
        # A damaged packet may have the type of a log line, too, but is mostly unreadable.
        is_readable = 2 * self.value.count('\N{REPLACEMENT CHARACTER}') <= len(self.value)
        return '' if is_readable else 'most of its characters are unreadable'


# Log lines, board -> us, by their type, which is the severity: 0 … 3.
LOGS: List[Any] = [type(label, (Text,), {'__slots__': (), 'TYPE': type_, 'LABEL': label})
                   for type_, label in enumerate(('DEBUG', 'INFO', 'WARN', 'ERROR'))]
SpeedCommand = message_class(
    'SpeedCommand', 4, '<h', [Value('value')], 'speed',
    'SPEED_CMD, us -> board: PWM of the drive motor, -1000 … 1000.')
SteeringCommand = message_class(
    'SteeringCommand', 5, '<H', [Value('value')], 'steering',
    'STEERING_CMD, us -> board: PWM of the steering servo, µs.')


class LedCommand(Text):
    """LED_CMD, us -> board: left, right, brake, disable …: at most 30 characters of ASCII."""

    __slots__ = ()
    TYPE = 6
    LABEL = 'LED'

    def pack(self) -> bytes:
        if len(self.value) > LED_LIMIT or not self.value.isascii() or '\0' in self.value:
            raise ValueError(f'LED text {brief(self.value, 30)} may have at most {LED_LIMIT} '
                             'characters of ASCII, without a NUL')
        return super().pack()


SteeringAngle = message_class(
    'SteeringAngle', 7, '<H', [Value('value', minimum=0, maximum=1024)], 'steering angle',
    'STEERING_ANGLE, board -> us: raw servo feedback, 0 … 1024.')
Ticks = message_class(
    'Ticks', 8, '<B', [Value('value')], 'ticks',
    'TICKS, board -> us: encoder ticks in the last 0.01 s.')
Voltage = message_class(
    'Voltage', 10, '<f', [Value('value', 'V', minimum=0, maximum=100)], 'voltage',
    'VOLTAGE, board -> us: battery volts, averaged over 3 s.')
Heartbeat = message_class(
    'Heartbeat', 11, '<', (), 'heartbeat',
    'HEARTBEAT, us -> board. The board stops its motor after 30 ms without one.')
ImuCalibration = message_class(
    'ImuCalibration', 12, '<', (), 'calibrate the IMU',
    'IMU_CALIBRATION, us -> board: it calibrates for over 5 minutes and reads nothing meanwhile.')


class Imu(LayoutMessage, namedtuple(
        'Imu', 'qw qx qy qz gx gy gz ax ay az raw_temperature')):
    """IMU, board -> us: the raw numbers of the motion processor, in its axes and units.

    The methods return SI units in ROS's axes: x = board y, y = -board x, z = board z.
    """

    __slots__ = ()
    TYPE = 9
    LABEL = 'IMU'
    LAYOUT = Layout('>11h', [    # in the board's axes, with the default gyro_scale
        *[Value(f'quaternion {axis}', '', _QUATERNION) for axis in 'wxyz'],
        *[Value(f'angular rate {axis}', 'rad/s', GYRO_SCALE) for axis in 'xyz'],
        *[Value(f'acceleration {axis}', 'm/s²', _ACCELERATION) for axis in 'xyz'],
        Value('temperature', '°C', 1 / 340, 36.53)])

    @classmethod
    def unpack(cls, data: bytes) -> 'Imu':
        return tuple.__new__(cls, cls.LAYOUT.raw(data))

    def pack(self) -> bytes:
        return struct.pack(self.LAYOUT.layout, *self)

    def orientation(self) -> Quaternion:
        """x, y, z, w."""
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
        """Why these values are impossible, or ''."""
        qw, qx, qy, qz = self[:4]
        square = qw * qw + qx * qx + qy * qy + qz * qz
        if _LEAST_SQUARED <= square <= _MOST_SQUARED:
            return ''
        norm = square ** 0.5 * _QUATERNION
        return f'the norm of the quaternion is {norm:.3f}, may be 0.95 … 1.05'

    def __str__(self) -> str:
        return 'IMU q ({:.3f} {:.3f} {:.3f} {:.3f}) a ({:.2f} {:.2f} {:.2f}) m/s^2'.format(
            *self.orientation(), *self.linear_acceleration())


Time = message_class(
    'Time', 254, '<IB', [Value(BOARD_TIME, 'us'), Value('count', minimum=1, maximum=16)], 'time',
    'TIME, board -> us: the board\'s time when it measured what the next `count` packets hold.')

FROM_BOARD = (SteeringAngle, Ticks, Imu, Voltage)
TO_BOARD = (SpeedCommand, SteeringCommand, LedCommand, Heartbeat, ImuCalibration)
# A custom message has none of these types.
BUILT_IN = by_type(*FROM_BOARD, *TO_BOARD, *LOGS, Time, SettingMessage, announcement.Chunk)
# TIME does not count packets of these types.
_UNTIMED = frozenset((0, 1, 2, 3, SETTING, announcement.TYPE))


def encode(message: Any) -> bytes:
    """The packet as it is sent, with the 0x00 at its end.

    ValueError for a value that the message does not allow, or a packet that is too long;
    struct.error for a raw number of the IMU that does not fit an int16.
    """
    return encode_raw(message.TYPE, message.pack())


def encode_raw(type_: int, data: bytes) -> bytes:
    """A packet of any type, 0 … 255; ValueError if it has more than `MAX_PACKET` bytes."""
    if len(data) >= MAX_PACKET:
        raise ValueError(f'{len(data)} bytes of data, a packet holds at most {MAX_PACKET - 1}')
    return cobs.encode(bytes((type_,)) + data) + b'\0'


class _Decoder(stream.Decoder):
    """Decodes packets that end with 0x00. After an invalid packet, the next begins after its 0x00.

    If that 0x00 is lost or changed, two packets become one invalid packet. This framing cannot
    recover the second one.

    Args:
        check_plausibility: treat packets with impossible values as invalid.
        messages: classes of custom messages: see `message_class`. Their limits are always checked.
    """

    CAUSES = FRAMING, OVERSIZE, LENGTH, UNKNOWN, IMPLAUSIBLE
    needed = _MAX_ENCODED      # bytes of the longest packet: no packet says how long it is

    def __init__(self, check_plausibility: bool = True,
                 messages: Iterable[Type[LayoutMessage]] = ()) -> None:
        super().__init__(messages)
        # A count over 16 in TIME would give its time to packets of later measurements, and a
        # setting that is NaN is never equal to what is wanted.
        if not check_plausibility:
            self.unchecked = frozenset(self.MESSAGES.keys() - {Time.TYPE, SETTING})

    def _begin(self) -> None:
        self._begun = b''          # the incomplete packet; of one that is too long, its beginning
        self._stamp: Any = None    # of the read with the packet's latest byte
        self._ticks = 0            # of the latest TIME
        self._timed = 0            # how many of the next packets it is for

    def feed(self, data: bytes, stamp: Any = None) -> List[Frame]:
        frames: List[Frame] = []
        self.received += len(data)
        data = self._begun + data
        packets, behind = data.split(b'\0'), len(data)
        self._begun = packets.pop()[:_MAX_ENCODED + 1]
        for packet in packets:
            behind -= len(packet) + 1
            if packet:
                frames.append(self._packet(packet, stamp, behind))
        self._stamp = stamp
        self.front = self.received - len(self._begun)
        return frames

    def give_up(self) -> List[Frame]:
        frames: List[Frame] = []
        if self._begun:
            frames.append(invalid_frame(self._begun, FRAMING, 'an incomplete packet', self._stamp))
        self.reset()
        return frames

    def _packet(self, encoded: bytes, stamp: Any, behind: int) -> Frame:
        packet = cobs.decode_or_none(encoded)
        if not packet or len(packet) > MAX_PACKET:
            self._timed = 0
            if packet or len(encoded) > _MAX_ENCODED:
                return invalid_frame(encoded[:_MAX_ENCODED + 1], OVERSIZE,
                                     f'a packet of over {MAX_PACKET} bytes', stamp)
            return invalid_frame(encoded + b'\0', FRAMING, 'a packet without a type'
                                 if packet == b'' else
                                 'a COBS code points past the end of the packet', stamp)
        type_, ticks = packet[0], None
        if self._timed and type_ not in _UNTIMED:
            self._timed -= 1
            ticks = self._ticks
        frame = self.whole(encoded + b'\0', type_, 0, packet[1:], ticks, stamp, behind)
        if frame.cause:
            self._timed = 0      # it may have been one of the packets that TIME counts
        elif type_ == Time.TYPE:
            self._ticks, self._timed = frame.message
        return frame


class Decoder(_Decoder):
    """Decodes what the board sends."""

    MESSAGES = by_type(*FROM_BOARD, *LOGS, Time, SettingMessage, announcement.Chunk)


class BoardDecoder(_Decoder):
    """Decodes what is sent to the board; for simulated boards and for displays."""

    MESSAGES = by_type(*TO_BOARD, SettingMessage)
