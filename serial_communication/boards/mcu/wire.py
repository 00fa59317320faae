"""The sensor board's frames, STX … ETX, from an ESP32 with range sensors and an IMU.

    +------+-----+------+-----+-----------+-----+------+
    | 0x02 | LEN | TYPE | SEQ | PAYLOAD … | CRC | 0x03 |
    +------+-----+------+-----+-----------+-----+------+
     STX                                         ETX

LEN counts TYPE, SEQ and PAYLOAD; CRC is the XOR of TYPE, SEQ and PAYLOAD; SEQ counts up by one
a frame, modulo 256. Little-endian. Only the board sends, except for settings.
"""
import struct
from collections import namedtuple
from math import isnan, nan
from typing import Optional, Union

from ...framing.announcement import Chunk
from ...framing.layout import BOARD_TIME, Layout, LayoutMessage, Value, message_class
from ...framing.rows import SettingMessage
from ...framing.stream import (CHECKSUM, FRAMING, IMPLAUSIBLE, LENGTH, UNKNOWN, Frame,
                               StreamDecoder, by_type, invalid_frame, running_xor)

STX = 0x02
ETX = 0x03
MIN_LEN = 2            # TYPE and SEQ
MAX_PAYLOAD = 253      # bytes
RANGE_TIMED_OUT = 0xFFFF  # in place of a range: the sensor timed out
ANGLE_UNKNOWN = -0x8000   # pitch and roll where the IMU did not answer: no attitude has -327.68°


class SensorStatus(LayoutMessage, namedtuple(
        'SensorStatus', 'range_1 range_2 yaw pitch roll')):
    """TYPE 0x10: two range sensors and the orientation as Euler angles.

    Ranges are in mm; 0xFFFF: the sensor timed out. Angles are in degrees, the yaw a heading
    0 … 360, clockwise; NaN: the IMU did not answer.
    """

    __slots__ = ()
    TYPE = 0x10
    LABEL = 'sensor status'
    LAYOUT = Layout('<HHhhh', [
        Value('range_1', 'mm'), Value('range_2', 'mm'), Value('yaw', 'degrees', 0.01),
        Value('pitch', 'degrees', 0.01), Value('roll', 'degrees', 0.01)])

    @classmethod
    def unpack(cls, data: bytes) -> 'SensorStatus':
        """From ten bytes; struct.error for more or fewer. A yaw under -180° is a heading that
        wrapped; it is restored, and one over 360° is given as the same direction under 360°."""
        range_1, range_2, yaw, pitch, roll = cls.LAYOUT.raw(data)
        if pitch == roll == ANGLE_UNKNOWN:    # yaw alone cannot tell: it may be a heading
            return cls(range_1, range_2, nan, nan, nan)
        if yaw < -18000:
            yaw += 0x10000
            yaw -= 36000 * (yaw > 36000)
        return tuple.__new__(cls, (range_1, range_2, yaw / 100, pitch / 100, roll / 100))

    def pack(self) -> bytes:
        """The payload. Angles are rounded to 0.01° and wrap as the board's int16 does."""
        wrapped = [0, ANGLE_UNKNOWN, ANGLE_UNKNOWN] if not self.angles_known else [
            (round(angle * 100) + 0x8000) % 0x10000 - 0x8000
            for angle in (self.yaw, self.pitch, self.roll)]
        return struct.pack(self.LAYOUT.layout, self.range_1, self.range_2, *wrapped)

    @property
    def angles_known(self) -> bool:
        """Whether the IMU answered."""
        return not isnan(self.pitch)

    @property
    def valid(self) -> bool:
        """Whether all sensors answered."""
        return RANGE_TIMED_OUT not in (self.range_1, self.range_2) and self.angles_known


AdcStatus = message_class(
    'AdcStatus', 0x01, '<6H', [Value(f'adc{channel}') for channel in range(6)], 'ADC status',
    'TYPE 0x01: six ADC channels, raw.')

Time = message_class(
    'Time', 0xFE, '<I', [Value(BOARD_TIME, 'us')], 'time',
    'TYPE 0xFE: the board\'s time when it measured what the frame with the next SEQ holds.')

FROM_BOARD = (SensorStatus, AdcStatus)
MESSAGES = by_type(*FROM_BOARD)
# A custom message has none of these types.
BUILT_IN = by_type(*FROM_BOARD, Time, SettingMessage, Chunk)
_LENS = {message.TYPE: MIN_LEN + message.LAYOUT.size for message in (*FROM_BOARD, Time)}


def encode(message: LayoutMessage, seq: int) -> bytes:
    """The frame with `message` and the running number `seq` (0 … 255)."""
    return encode_raw(message.TYPE, seq, message.pack())


def encode_raw(type_: int, seq: int, payload: bytes) -> bytes:
    """A frame of any TYPE, 0 … 255; `payload` has at most `MAX_PAYLOAD` bytes."""
    body = bytes((type_, seq)) + payload
    return bytes((STX, len(body))) + body + bytes((running_xor(body, 0)[-1], ETX))


class Decoder(StreamDecoder):
    """Decodes what the board sends, and settings in both directions."""

    MESSAGES = BUILT_IN
    CAUSES = CHECKSUM, FRAMING, UNKNOWN, LENGTH, IMPLAUSIBLE
    STARTS = bytes((STX,))

    def _begin(self) -> None:
        super()._begin()
        self._ticks: Optional[int] = None    # of a TIME that was the latest frame
        self._timed_seq = -1                 # the SEQ of the frame that it is for

    def frame_at(self, at: int) -> Union[Frame, int, None]:
        buffer = self.buffer
        left = len(buffer) - at
        if left < 3:
            return 3
        length, type_ = buffer[at + 1], buffer[at + 2]
        if length < MIN_LEN or _LENS.get(type_, length) != length:
            return None
        size = length + 4
        if left < size:
            return size
        end = at + size
        if buffer[end - 1] != ETX:
            return None
        if self.xor(at + 2, end - 1):    # TYPE … CRC: 0 in a valid frame
            return invalid_frame(buffer[at:end], CHECKSUM, 'CRC does not match')
        seq, data = buffer[at + 3], buffer[at + 4:end - 2]
        ticks = self._ticks if seq == self._timed_seq else None
        frame = self.whole(buffer[at:end], type_, seq, data, ticks)
        is_time = type_ == Time.TYPE and not frame.cause
        self._ticks, self._timed_seq = frame.ticks, (seq + 1) % 256 if is_time else -1
        return frame
