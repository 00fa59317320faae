"""The protocols of doc/protocols.md, byte by byte, without the package's code: small and slow.

Tests and the judge use these decoders, so that an error in the package's decoders cannot
hide itself. Each protocol is one function, `frame_at`, which returns the frame that begins at a
given place of a stream. `decode` returns the frames that a decoder must find, and `all_frames` the
valid frames at any place: no decoder may find others, whatever the damage is.
test/unit/boards compares this file with the package.
"""
import struct
from typing import Callable, List, NamedTuple, Optional, Tuple, Union

INCOMPLETE = 'a frame may begin here; more bytes are needed'
MAX_DATE = 1024            # bytes of DATE on the bus
MAX_PACKET = 256           # bytes of an Arduino packet, including its type

# bus: CMD1 of requests and replies, CMD2 of requests, error codes
SYNC, ECHO, FUNCTION = 0x00, 0x01, 0x55
OK, ERROR, INVALID = 0x02, 0x03, 0xFF
LIFT, GIMBAL, ENVIRONMENT = 0x20, 0x21, 0x22
BAD_CHECKSUM, NOT_SYNCHRONISED, FAILED = 0x40, 0x10, 0x8002
# arduino: message types
SPEED, STEERING, LED, STEERING_ANGLE, TICKS, IMU, VOLTAGE, HEARTBEAT, CALIBRATION = range(4, 13)
SETTING, TIME, ANNOUNCEMENT = 253, 254, 255
# mcu: TYPEs
SENSORS, ADC = 0x10, 0x01
_MCU_LEN = {SENSORS: 12, ADC: 14, 0xFE: 6}
_ENVIRONMENT_REQUEST = bytes((0xA5, 2, FUNCTION, ENVIRONMENT, 0xD0))


class Frame(NamedTuple):
    """A valid frame. `number` is CMD2 of a request, SEQ of an mcu frame, or else 0."""

    type: int
    number: int
    data: bytes
    start: int      # position in the stream
    end: int        # where the next frame may begin

    @property
    def content(self) -> Tuple[int, int, bytes]:
        """The frame without its position."""
        return self.type, self.number, self.data


Found = Union[None, str, Frame]          # None (no valid frame begins there), INCOMPLETE or Frame
FrameAt = Callable[[bytes, int], Found]


def xor_of(data: bytes) -> int:
    """The XOR of all bytes."""
    value = 0
    for byte in data:
        value ^= byte
    return value


def cobs_encode(data: bytes) -> bytes:
    """The COBS encoding without the 0x00 at the end of a packet."""
    out, block = bytearray(), bytearray()
    for index, byte in enumerate(data):
        if byte:
            block.append(byte)
        # No block follows a full block at the end.
        if not byte or len(block) == 254 and index + 1 < len(data):
            out.append(len(block) + 1)
            out += block
            block.clear()
    out.append(len(block) + 1)
    return bytes(out + block)


# -- announcements --------------------------------------------------------------------------


def announcement(text: bytes, size: int) -> List[bytes]:
    """The chunks of an announcement, with `size` bytes of its text each."""
    crc = 0xFFFF
    for byte in text:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ (0x1021 if crc & 0x8000 else 0)) & 0xFFFF
    pieces = [text[at:at + size] for at in range(0, len(text), size)]
    return [struct.pack('<BBH', index, len(pieces), crc) + piece
            for index, piece in enumerate(pieces)]


# -- bus ------------------------------------------------------------------------------------


def bus_frame(commands: bytes, data: bytes) -> bytes:
    """A request has two `commands`, CMD1 and CMD2; a reply has one."""
    size = struct.pack('<B', len(data)) if len(data) < 255 else struct.pack('<H', len(data))
    frame = (b'\xA5' if len(data) < 255 else b'\x5A') + size + commands + data
    return frame + bytes((xor_of(frame),))


def bus_at(stream: bytes, at: int, commands: int) -> Found:
    """A frame with this number of commands."""
    if stream[at] not in b'\xA5\x5A':
        return None
    size_bytes = 1 if stream[at] == 0xA5 else 2
    header = at + 1 + size_bytes
    if len(stream) < header:
        return INCOMPLETE
    size = int.from_bytes(stream[at + 1:header], 'little')
    if (size < 255) != (size_bytes == 1) or size > MAX_DATE:
        return None
    end = header + commands + size + 1
    if len(stream) < end:
        return INCOMPLETE
    if xor_of(stream[at:end]):
        return None
    return Frame(stream[header], stream[header + 1] if commands == 2 else 0,
                 stream[header + commands:end - 1], at, end)


def reply_at(stream: bytes, at: int) -> Found:
    """A reply of a bus board."""
    return bus_at(stream, at, 1)


def request_at(stream: bytes, at: int) -> Found:
    """A request to a bus board. The environment request has Datelen 2 but no DATE."""
    beginning = stream[at:at + len(_ENVIRONMENT_REQUEST)]
    if beginning == _ENVIRONMENT_REQUEST:
        return Frame(FUNCTION, ENVIRONMENT, b'', at, at + len(beginning))
    found = bus_at(stream, at, 2)
    if found is INCOMPLETE or _ENVIRONMENT_REQUEST.startswith(beginning):
        return INCOMPLETE
    return found


# -- mcu ------------------------------------------------------------------------------------


def mcu_frame(type_: int, seq: int, payload: bytes) -> bytes:
    """A frame of the sensor board."""
    body = bytes((type_, seq)) + payload
    return bytes((0x02, len(body))) + body + bytes((xor_of(body), 0x03))


def mcu_at(stream: bytes, at: int) -> Found:
    """A frame of the sensor board."""
    if stream[at] != 0x02:
        return None
    beginning = stream[at:at + 3]
    if len(beginning) > 1 and beginning[1] < 2:
        return None
    if len(beginning) < 3:
        return INCOMPLETE
    end = at + beginning[1] + 4
    if _MCU_LEN.get(beginning[2], beginning[1]) != beginning[1]:
        return None
    if len(stream) < end:
        return INCOMPLETE
    if stream[end - 1] != 0x03 or xor_of(stream[at + 2:end - 1]):
        return None
    return Frame(stream[at + 2], stream[at + 3], stream[at + 4:end - 2], at, end)


# -- arduino --------------------------------------------------------------------------------


def arduino_packet(type_: int, data: bytes = b'') -> bytes:
    """A packet in either direction, with the 0x00 at its end."""
    return cobs_encode(bytes((type_,)) + data) + b'\0'


def _cobs(encoded: bytes) -> Optional[bytes]:
    """The decoded bytes; None if a code byte points beyond the end."""
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
    """A packet in either direction. Its length and values are not checked."""
    end = stream.find(b'\0', at)
    if end < 0:
        return INCOMPLETE
    packet = _cobs(stream[at:end])
    if not packet or len(packet) > MAX_PACKET:
        return None
    return Frame(packet[0], 0, packet[1:], at, end + 1)


# -- streams --------------------------------------------------------------------------------


def decode(stream: bytes, frame_at: FrameAt, at_end: bool = False) -> Tuple[List[Frame], int]:
    """The frames that a decoder must find, and where the incomplete rest begins.

    Args:
        at_end: no more bytes follow, so the rest is no frame but may contain frames.
    """
    frames, at = [], 0
    while at < len(stream):
        found = frame_at(stream, at)
        if isinstance(found, Frame):
            frames.append(found)
            at = found.end
        elif found is INCOMPLETE and not at_end:
            break
        elif frame_at is arduino_at:        # the next packet begins after the next 0x00
            at = stream.find(b'\0', at) + 1 or len(stream)
        else:                               # the next frame may begin at any byte
            at += 1
    return frames, at


def all_frames(stream: bytes, frame_at: FrameAt) -> List[Frame]:
    """The valid frames that begin at any byte. A decoder must not find others."""
    found = (frame_at(stream, at) for at in range(len(stream)))
    return [frame for frame in found if isinstance(frame, Frame)]


class Reader:
    """Decodes a stream that is received in pieces.

    Args:
        timeout: s without a byte after which an incomplete frame is dropped.
    """

    def __init__(self, frame_at: FrameAt, timeout: float = 0.1) -> None:
        self._frame_at = frame_at
        self._timeout = timeout
        self._rest = b''
        self._at = 0.0

    def feed(self, data: bytes, now: float) -> List[Frame]:
        """Return the frames that these bytes complete."""
        frames: List[Frame] = []
        if self._rest and now - self._at > self._timeout:
            if self._frame_at is not arduino_at:
                frames = decode(self._rest, self._frame_at, True)[0]
            self._rest = b''
        self._at = now
        stream = self._rest + data
        found, at = decode(stream, self._frame_at)
        self._rest = stream[at:]
        return frames + found

    def reset(self) -> None:
        """Forget the incomplete frame, since the line was opened again."""
        self._rest = b''
