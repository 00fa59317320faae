"""The sensor board's frames: STX ... ETX, from an ESP32 with range sensors and an IMU.

    +------+-----+------+-----+-----------+-----+------+
    | 0x02 | LEN | TYPE | SEQ | PAYLOAD … | CRC | 0x03 |
    +------+-----+------+-----+-----------+-----+------+
     STX                                         ETX

LEN counts TYPE, SEQ and PAYLOAD; CRC is the XOR of TYPE, SEQ and PAYLOAD; SEQ counts up by one
a frame, modulo 256. Little-endian. Only the board talks.
"""
from typing import Any, Iterable, List, NamedTuple

from .framing import CHECKSUM, FRAMING, UNKNOWN, StreamDecoder, running_xor
from .layout import Layout, Value, message_class
from .parts import Part, Parts

STX = 0x02
ETX = 0x03
MIN_LEN = 2            # TYPE and SEQ
RANGE_TIMED_OUT = 0xFFFF  # what a range sensor that did not answer reads

_WRAP = 655.36         # degrees by which a heading over 327.67 wraps in the int16


class SensorStatus(NamedTuple):
    """TYPE 0x10: two range sensors and the orientation as Euler angles."""

    TYPE = 0x10
    LABEL = 'sensor status'
    LAYOUT = Layout('<HHhhh', [
        Value('range_1', 'mm'), Value('range_2', 'mm'), Value('yaw', 'degrees', 0.01),
        Value('pitch', 'degrees', 0.01), Value('roll', 'degrees', 0.01)])

    range_1: int   # mm; 0xFFFF: the sensor timed out
    range_2: int   # mm; 0xFFFF: the sensor timed out
    yaw: float     # degrees, heading 0 … 360, clockwise
    pitch: float   # degrees
    roll: float    # degrees

    @classmethod
    def unpack(cls, data: bytes) -> 'SensorStatus':
        """From the payload. A yaw under -180° is a heading that wrapped: restored."""
        range_1, range_2, yaw, pitch, roll = cls.LAYOUT.raw(data)
        yaw /= 100
        return cls(range_1, range_2, yaw if yaw >= -180 else round(yaw + _WRAP, 2), pitch / 100,
                   roll / 100)

    def pack(self) -> bytes:
        """The payload. Angles are rounded to 0.01° and wrap as the board's int16 does."""
        wrapped = [(round(angle * 100) + 0x8000) % 0x10000 - 0x8000
                   for angle in (self.yaw, self.pitch, self.roll)]
        return self.LAYOUT.pack_raw((self.range_1, self.range_2, *wrapped))

    @classmethod
    def parts(cls, payload: bytes) -> List[Part]:
        """Which bytes of the payload are which value."""
        parts = cls.LAYOUT.parts(payload)
        if cls.LAYOUT.fits(len(payload)):
            parts = [part._replace(value=value) for part, value in zip(parts, cls.unpack(payload))]
        for index, part in enumerate(parts):
            if part.unit == 'mm' and part.raw == RANGE_TIMED_OUT:
                parts[index] = part._replace(meaning='the sensor timed out')
            elif part.name == 'yaw' and part.raw is not None and part.raw < -18000:
                parts[index] = part._replace(meaning='a heading that wrapped')
        return parts

    @property
    def valid(self) -> bool:
        """Whether both range sensors answered."""
        return self.range_1 != RANGE_TIMED_OUT and self.range_2 != RANGE_TIMED_OUT

    def __str__(self) -> str:
        ranges = ' '.join('timed out' if value == RANGE_TIMED_OUT else f'{value} mm'
                          for value in (self.range_1, self.range_2))
        return (f'sensor status: {ranges}, yaw {self.yaw:.2f} pitch {self.pitch:.2f} '
                f'roll {self.roll:.2f}')


AdcStatus = message_class(
    'AdcStatus', 0x01, '<6H', [Value(f'adc{channel}') for channel in range(6)], 'ADC status',
    'TYPE 0x01: six ADC channels, raw.')

MESSAGES = {message.TYPE: message for message in (SensorStatus, AdcStatus)}


def encode(message: Any, seq: int) -> bytes:
    """The frame that carries `message` as the board's frame number `seq` (0 … 255)."""
    return encode_raw(message.TYPE, seq, message.pack())


def encode_raw(type_: int, seq: int, payload: bytes) -> bytes:
    """A frame of any TYPE; `payload` up to 253 bytes."""
    body = bytes((type_, seq)) + payload
    return bytes((STX, len(body))) + body + bytes((running_xor(body, 0)[-1], ETX))


class Decoder(StreamDecoder):
    """Board -> us. A frame's `message` is None where its TYPE is not known.

    Args:
        messages: classes of messages of one's own, see `message_class`.
    """

    def __init__(self, messages: Iterable[Any] = ()) -> None:
        super().__init__()
        self.errors[UNKNOWN] = 0
        self._messages = dict(MESSAGES)
        self._messages.update((message.TYPE, message) for message in messages)
        self._lengths = {type_: MIN_LEN + message.LAYOUT.size
                         for type_, message in MESSAGES.items()}

    def explain(self, frame: bytes) -> List[Part]:
        """The bytes of one frame, good, bad, incomplete or noise, by name."""
        parts = Parts(frame)
        if frame[:1] != bytes((STX,)):
            return parts.take_rest('noise', 'no frame begins so')
        parts.take(1, 'STX')
        kind = self._messages.get(frame[2]) if len(frame) > 2 else None
        own = MIN_LEN + kind.LAYOUT.size if kind else 0
        length = frame[1] if len(frame) > 1 else own
        should_be = '' if length >= MIN_LEN else f'should be {MIN_LEN} at least'
        if own and length != own:
            should_be = f'should be {own}'
        parts.take(1, 'LEN', 'bytes of TYPE, SEQ and PAYLOAD', should_be)
        if length < MIN_LEN:
            return parts.take_rest('noise', 'bytes behind a false LEN')
        parts.take(1, 'TYPE', kind.LABEL if kind else 'not known here')
        parts.take(1, 'SEQ')
        if kind:
            parts.take_data(length - MIN_LEN, kind.parts)
        else:
            parts.take_bytes(length - MIN_LEN, 'PAYLOAD')
        parts.take_checksum('CRC', frame[2:2 + length])
        parts.take(1, 'ETX', error='' if frame[length + 3:length + 4] in (b'', b'\3')
                   else 'should be 0x03')
        return parts.take_rest('noise', 'bytes behind the frame')

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
                own = self._lengths.get(type_)
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
                        message = self._messages[type_].unpack(data)
                    else:
                        self.errors[UNKNOWN] += 1
                    self._good(start, end, type_, buffer[start + 3], data, message)
                    at = blamed = end
                    continue
            if start >= blamed:
                self._failed(start, end, cause, error)
                blamed = end
            at = start + 1
