"""NMEA 0183: $WIMWV,ANGLE,R,SPEED,M,A*hh CR LF, where hh is the XOR of all between $ and *.

`StreamDecoder` finds the frames in the stream and begins again after damage. `frame_at` only
decides what begins at a byte: a frame, valid or not, None, or how many bytes are needed to tell.
"""
from functools import reduce
from typing import NamedTuple, Union

from serial_communication.framing.stream import (CHECKSUM, FRAMING, IMPLAUSIBLE, UNKNOWN, Frame,
                                                 StreamDecoder, invalid_frame)

LONGEST = 82      # bytes of a sentence, by the standard


class Wind(NamedTuple):
    """MWV, the wind over the deck."""

    angle: float     # degrees, clockwise from the bow
    speed: float     # m/s

    def __str__(self) -> str:
        return f'wind from {self.angle:.0f} degrees, {self.speed:.1f} m/s'


def encode(wind: Wind) -> bytes:
    """The sentence."""
    body = f'WIMWV,{wind.angle:05.1f},R,{wind.speed:05.1f},M,A'.encode()
    return b'$%b*%02X\r\n' % (body, checksum(body))


def checksum(body: bytes) -> int:
    """XOR of every byte."""
    return reduce(lambda value, byte: value ^ byte, body, 0)


class Decoder(StreamDecoder):
    """Sensor -> us."""

    CAUSES = CHECKSUM, FRAMING, UNKNOWN, IMPLAUSIBLE
    STARTS = b'$'

    def frame_at(self, at: int) -> Union[Frame, int, None]:
        end = self.buffer.find(b'\r\n', at, at + LONGEST)
        if end < 0:
            begun = len(self.buffer) - at
            return begun + 1 if begun < LONGEST else None
        raw = self.buffer[at:end + 2]
        body, star, digits = raw[1:-2].rpartition(b'*')
        if not star or b'$' in body:
            return None
        if digits != b'%02X' % checksum(body):
            return invalid_frame(raw, CHECKSUM, 'the checksum does not match')
        kind, *fields = body.decode('ascii', 'replace').split(',')
        if kind != 'WIMWV':
            return Frame(raw, 0, 0, body, None, cause=UNKNOWN, error=f'a {kind}')
        try:
            return Frame(raw, 0, 0, body, Wind(float(fields[0]), float(fields[2])))
        except (ValueError, IndexError):
            return Frame(raw, 0, 0, body, None, cause=IMPLAUSIBLE, error='no numbers')
