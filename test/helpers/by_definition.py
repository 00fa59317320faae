"""What the protocols say, byte by byte, without the package's code: small, slow, independent.

Tests compare with it, and the fault campaign judges by it, so that a fault of the package's
decoders cannot hide itself. It is written from doc/protocols.md. A protocol is one function here,
`frame_at`: which frame begins at this place of the stream? Two things follow from it: `decode`,
what a decoder has to find, and `all_frames`, every valid frame at any place, which is all that any
decoder can rightly find in damaged bytes. test/boards/test_by_definition.py compares it with the
package.
"""
import struct
from typing import Callable, List, NamedTuple, Optional, Tuple, Union

MORE = 'more bytes are needed to tell'
MAX_DATE = 1024            # bytes of DATE on the bus
MAX_PACKET = 256           # bytes of an Arduino packet with its type

# bus: CMD1 of requests and replies, CMD2 of requests, error codes
SYNC, ECHO, FUNCTION = 0x00, 0x01, 0x55
OK, ERROR, INVALID = 0x02, 0x03, 0xFF
LIFT, GIMBAL, ENVIRONMENT = 0x20, 0x21, 0x22
BAD_CHECKSUM, NOT_SYNCHRONISED, FAILED = 0x40, 0x10, 0x8002
# arduino: message types
SPEED, STEERING, LED, STEERING_ANGLE, TICKS, IMU, VOLTAGE, HEARTBEAT, CALIBRATION = range(4, 13)
# mcu: TYPEs
SENSORS, ADC = 0x10, 0x01
_MCU_LEN = {SENSORS: 12, ADC: 14}
_ENVIRONMENT_REQUEST = bytes((0xA5, 2, FUNCTION, ENVIRONMENT, 0xD0))


class Frame(NamedTuple):
    """One valid frame: `command` is CMD2 of a request, SEQ of an mcu frame, else 0."""

    type: int
    command: int
    data: bytes
    start: int      # its place in the stream
    end: int        # where the next one may begin

    @property
    def content(self) -> Tuple[int, int, bytes]:
        """Without its place."""
        return self.type, self.command, self.data


Found = Union[None, str, Frame]          # None: no valid frame begins there; MORE; or the frame
FrameAt = Callable[[bytes, int], Found]


def xor_of(data: bytes) -> int:
    """The XOR of every byte."""
    value = 0
    for byte in data:
        value ^= byte
    return value


def cobs_encode(data: bytes) -> bytes:
    """The COBS encoding, without the 0x00 that ends a packet."""
    out, block = bytearray(), bytearray()
    for index, byte in enumerate(data):
        if byte:
            block.append(byte)
        # A full block at the end needs no block after it.
        if not byte or len(block) == 254 and index + 1 < len(data):
            out.append(len(block) + 1)
            out += block
            block.clear()
    out.append(len(block) + 1)
    return bytes(out + block)


# -- bus ------------------------------------------------------------------------------------


def bus_frame(commands: bytes, data: bytes) -> bytes:
    """A request has two commands, a reply one."""
    size = struct.pack('<B', len(data)) if len(data) < 255 else struct.pack('<H', len(data))
    frame = (b'\xA5' if len(data) < 255 else b'\x5A') + size + commands + data
    return frame + bytes((xor_of(frame),))


def bus_at(stream: bytes, at: int, commands: int) -> Found:
    """One with so many commands."""
    if stream[at] not in b'\xA5\x5A':
        return None
    size_bytes = 1 if stream[at] == 0xA5 else 2
    header = at + 1 + size_bytes
    if len(stream) < header:
        return MORE
    size = int.from_bytes(stream[at + 1:header], 'little')
    if (size < 255) != (size_bytes == 1) or size > MAX_DATE:
        return None
    end = header + commands + size + 1
    if len(stream) < end:
        return MORE
    if xor_of(stream[at:end]):
        return None
    return Frame(stream[header], stream[header + 1] if commands == 2 else 0,
                 stream[header + commands:end - 1], at, end)


def reply_at(stream: bytes, at: int) -> Found:
    """From a board on the bus."""
    return bus_at(stream, at, 1)


def request_at(stream: bytes, at: int) -> Found:
    """To a board on the bus. The documented environment request says Datelen 2 without a DATE."""
    begun = stream[at:at + len(_ENVIRONMENT_REQUEST)]
    if begun == _ENVIRONMENT_REQUEST:
        return Frame(FUNCTION, ENVIRONMENT, b'', at, at + len(begun))
    found = bus_at(stream, at, 2)
    return MORE if found is MORE or _ENVIRONMENT_REQUEST.startswith(begun) else found


# -- mcu ------------------------------------------------------------------------------------


def mcu_frame(type_: int, seq: int, payload: bytes) -> bytes:
    """From the sensor board."""
    body = bytes((type_, seq)) + payload
    return bytes((0x02, len(body))) + body + bytes((xor_of(body), 0x03))


def mcu_at(stream: bytes, at: int) -> Found:
    """From the sensor board."""
    if stream[at] != 0x02:
        return None
    begun = stream[at:at + 3]
    if len(begun) > 1 and begun[1] < 2:
        return None
    if len(begun) < 3:
        return MORE
    end = at + begun[1] + 4
    if _MCU_LEN.get(begun[2], begun[1]) != begun[1]:
        return None
    if len(stream) < end:
        return MORE
    if stream[end - 1] != 0x03 or xor_of(stream[at + 2:end - 1]):
        return None
    return Frame(stream[at + 2], stream[at + 3], stream[at + 4:end - 2], at, end)


# -- arduino --------------------------------------------------------------------------------


def arduino_packet(type_: int, data: bytes = b'') -> bytes:
    """Either way, with the 0x00 that ends it."""
    return cobs_encode(bytes((type_,)) + data) + b'\0'


def _cobs(encoded: bytes) -> Optional[bytes]:
    """Undone; None where a code runs past the end."""
    out, at = b'', 0
    while at < len(encoded):
        code = encoded[at]
        if at + code > len(encoded):
            return None
        out += encoded[at + 1:at + code]
        at += code
        if code < 255 and at < len(encoded):
            out += b'\0'
    return out


def arduino_at(stream: bytes, at: int) -> Found:
    """Either way. Whether the length is that of the type, and the values can be, is not asked."""
    end = stream.find(b'\0', at)
    if end < 0:
        return MORE
    packet = _cobs(stream[at:end])
    if not packet or len(packet) > MAX_PACKET:
        return None
    return Frame(packet[0], 0, packet[1:], at, end + 1)


# -- streams --------------------------------------------------------------------------------


def decode(stream: bytes, frame_at: FrameAt, given_up: bool = False) -> Tuple[List[Frame], int]:
    """What a decoder has to find, and where what is incomplete begins.

    Args:
        given_up: no more bytes come: what is incomplete is no frame.
    """
    frames, at = [], 0
    while at < len(stream):
        found = frame_at(stream, at)
        if isinstance(found, Frame):
            frames.append(found)
            at = found.end
        elif found is MORE and not given_up:
            break
        elif frame_at is arduino_at:        # the next packet begins behind the next 0x00
            at = stream.find(b'\0', at) + 1 or len(stream)
        else:                               # the next frame may begin at any byte
            at += 1
    return frames, at


def all_frames(stream: bytes, frame_at: FrameAt) -> List[Frame]:
    """Every valid frame that begins at any byte: a decoder cannot rightly find another one."""
    found = (frame_at(stream, at) for at in range(len(stream)))
    return [frame for frame in found if isinstance(frame, Frame)]


class Reader:
    """Frames of a stream that comes in pieces.

    Args:
        patience: s without a byte after which what is incomplete is given up.
    """

    def __init__(self, frame_at: FrameAt, patience: float = 0.1) -> None:
        self._frame_at = frame_at
        self._patience = patience
        self._rest = b''
        self._at = 0.0

    def feed(self, data: bytes, now: float) -> List[Frame]:
        """Those that are complete with these bytes."""
        frames: List[Frame] = []
        if self._rest and now - self._at > self._patience:
            if self._frame_at is not arduino_at:
                frames = decode(self._rest, self._frame_at, True)[0]
            self._rest = b''
        self._at = now
        stream = self._rest + data
        found, at = decode(stream, self._frame_at)
        self._rest = stream[at:]
        return frames + found

    def reset(self) -> None:
        """The line is another one."""
        self._rest = b''
