"""The sensor board's frames: STX ... ETX, from an ESP32 with range sensors and an IMU.

    +------+-----+------+-----+-----------+-----+------+
    | 0x02 | LEN | TYPE | SEQ | PAYLOAD … | CRC | 0x03 |
    +------+-----+------+-----+-----------+-----+------+
     STX                                         ETX

LEN counts TYPE, SEQ and PAYLOAD; CRC is the XOR of TYPE, SEQ and PAYLOAD; SEQ counts up by one
a frame, modulo 256. Little-endian. Only the board talks.
"""
from struct import Struct
from typing import Any, NamedTuple, Tuple

from .framing import CHECKSUM, FRAMING, UNKNOWN, StreamDecoder, running_xor

STX = 0x02
ETX = 0x03
MIN_LEN = 2            # TYPE and SEQ
RANGE_TIMED_OUT = 0xFFFF  # what a range sensor that did not answer reads

_new = tuple.__new__   # a NamedTuple without its constructor: decoding is mostly that
_WRAP = 655.36         # degrees by which a heading over 327.67 wraps in the int16


class SensorStatus(NamedTuple):
    """TYPE 0x10: two range sensors and the orientation as Euler angles."""

    TYPE = 0x10
    LAYOUT = Struct('<HHhhh')

    range_1: int   # mm; 0xFFFF: the sensor timed out
    range_2: int   # mm; 0xFFFF: the sensor timed out
    yaw: float     # degrees, heading 0 … 360, clockwise
    pitch: float   # degrees
    roll: float    # degrees

    @classmethod
    def unpack(cls, data: bytes) -> 'SensorStatus':
        """From the payload. A yaw under -180° is a heading that wrapped: restored."""
        range_1, range_2, yaw, pitch, roll = cls.LAYOUT.unpack(data)
        yaw /= 100
        return _new(cls, (range_1, range_2, yaw if yaw >= -180 else round(yaw + _WRAP, 2),
                          pitch / 100, roll / 100))

    def pack(self) -> bytes:
        """The payload. Angles are rounded to 0.01° and wrap as the board's int16 does."""
        angles = ((round(angle * 100) + 0x8000) % 0x10000 - 0x8000
                  for angle in (self.yaw, self.pitch, self.roll))
        return self.LAYOUT.pack(self.range_1, self.range_2, *angles)

    @property
    def valid(self) -> bool:
        """Whether both range sensors answered."""
        return self.range_1 != RANGE_TIMED_OUT and self.range_2 != RANGE_TIMED_OUT

    def __str__(self) -> str:
        ranges = ' '.join('timed out' if value == RANGE_TIMED_OUT else '%d mm' % value
                          for value in (self.range_1, self.range_2))
        return 'sensor status: %s, yaw %.2f pitch %.2f roll %.2f' % (
            ranges, self.yaw, self.pitch, self.roll)


class AdcStatus(NamedTuple):
    """TYPE 0x01: six ADC channels, raw."""

    TYPE = 0x01
    LAYOUT = Struct('<6H')

    channels: Tuple[int, int, int, int, int, int]

    @classmethod
    def unpack(cls, data: bytes) -> 'AdcStatus':
        """From the payload."""
        return cls(cls.LAYOUT.unpack(data))

    def pack(self) -> bytes:
        """The payload."""
        return self.LAYOUT.pack(*self.channels)

    def __str__(self) -> str:
        return 'ADC status: ' + ' '.join(map(str, self.channels))


MESSAGES = {message.TYPE: message for message in (SensorStatus, AdcStatus)}
_LENGTHS = [0] * 256   # by TYPE: the LEN it must have; 0: any
for _message in MESSAGES.values():
    _LENGTHS[_message.TYPE] = MIN_LEN + _message.LAYOUT.size


def encode(message: Any, seq: int) -> bytes:
    """The frame that carries `message` as the board's frame number `seq` (0 … 255)."""
    return encode_raw(message.TYPE, seq, message.pack())


def encode_raw(type_: int, seq: int, payload: bytes) -> bytes:
    """A frame of any TYPE; `payload` up to 253 bytes."""
    body = bytes((type_, seq)) + payload
    return bytes((STX, len(body))) + body + bytes((running_xor(body, 0)[-1], ETX))


class Decoder(StreamDecoder):
    """Board -> us. A frame's `message` is None where its TYPE is not known."""

    def __init__(self) -> None:
        super().__init__()
        self.errors[UNKNOWN] = 0

    def _search(self, at: int) -> None:
        buffer, xor = self._buffer, self._xor
        size = len(buffer)
        blamed = self._blamed - self._offset
        while True:
            start = buffer.find(STX, at)
            if start != at:
                if start < 0:
                    if at < size:
                        self._noise(at, size)
                    return self._keep(size, 1)
                self._noise(at, start)
            if start + 3 > size and not (start + 2 == size and buffer[start + 1] < MIN_LEN):
                return self._keep(start, size - start + 1)
            length = buffer[start + 1]
            cause = FRAMING
            if length < MIN_LEN:
                end, error = start + 2, 'LEN'
            else:
                type_ = buffer[start + 2]
                own = _LENGTHS[type_]
                end = start + length + 4
                if own and length != own:
                    end, error = start + 3, 'LEN'
                elif end > size:
                    return self._keep(start, end - start)
                elif buffer[end - 1] != ETX:
                    error = 'ETX'
                elif xor[end - 2] != xor[start + 1]:    # XOR of TYPE … CRC is 0 in a sound frame
                    cause, error = CHECKSUM, 'CRC does not match'
                else:
                    data = bytes(buffer[start + 4:end - 2])
                    message = None
                    if own:
                        message = MESSAGES[type_].unpack(data)
                    else:
                        self.errors[UNKNOWN] += 1
                    self._good(start, end, type_, buffer[start + 3], data, message)
                    at = blamed = end
                    continue
            if start >= blamed:
                self._failed(start, end, cause, error)
                blamed = end
            at = start + 1
