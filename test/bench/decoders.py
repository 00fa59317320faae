"""The package's decoders against state machines that take a byte at a time.

The latter are what the boards' own documents show: a state, a byte, a branch. Both give the
same typed messages for clean traffic; on noise the machines lose frames that the package's
decoders find, since they go on behind a false frame's end.
"""
import random
import time
from functools import partial
from typing import Any, Callable, Dict, List, NamedTuple, Tuple

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.bus import wire as bus
from serial_communication.framing.stream import Frame
from campaign.hostile import decoder_costs
from campaign.worst_streams import worst_streams
from .boards import arduino_turn, mcu_turn
from .figures import Decoding, Speed

READ = 4096     # bytes in one large read
_WORST = 3      # hostile streams of each link: those that cost the package's decoder most
_KNOWN = {message.TYPE: message for message in (
    arduino.SteeringAngle, arduino.Ticks, arduino.Imu, arduino.Voltage)}


class _ByteWise:
    """What the three state machines share."""

    def feed(self, data: bytes) -> List[Any]:
        """The messages that are complete now."""
        messages = []
        for byte in data:
            message = self._byte(byte)
            if message is not None:
                messages.append(message)
        return messages

    def _byte(self, byte: int) -> Any:
        """The message that this byte completes, or None."""
        raise NotImplementedError


class ByteMcu(_ByteWise):
    """STX LEN body ETX, a byte at a time."""

    def __init__(self) -> None:
        self._state = 'WAIT_STX'
        self._buffer = bytearray()
        self._length = 0

    def _byte(self, byte: int) -> Any:
        if self._state == 'WAIT_STX':
            if byte == mcu.STX:
                self._state = 'READ_LEN'
        elif self._state == 'READ_LEN':
            self._length = byte
            self._buffer.clear()
            self._state = 'READ_BODY'
        elif self._state == 'READ_BODY':
            self._buffer.append(byte)
            if len(self._buffer) == self._length + 1:
                self._state = 'READ_ETX'
        else:
            self._state = 'WAIT_STX'
            if byte == mcu.ETX:
                return self._frame(self._buffer)
        return None

    @staticmethod
    def _frame(data: bytearray) -> Any:
        crc = 0
        for byte in data[:-1]:
            crc ^= byte
        if crc != data[-1] or len(data) < 3:
            return None
        message = mcu.MESSAGES.get(data[0])
        payload = bytes(data[2:-1])
        if message is None or len(payload) != message.LAYOUT.size:
            return None
        return message.unpack(payload)


class ByteArduino(_ByteWise):
    """A byte at a time up to a 0x00, then COBS undone a byte at a time, as PacketSerial does."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._overflow = False

    def _byte(self, byte: int) -> Any:
        if byte == 0:
            message = None
            if self._buffer and not self._overflow:
                message = self._packet(self._buffer)
            self._buffer.clear()
            self._overflow = False
            return message
        if len(self._buffer) <= arduino.MAX_PACKET + 1:
            self._buffer.append(byte)
        else:
            self._overflow = True
        return None

    def _packet(self, encoded: bytearray) -> Any:
        packet = bytearray()
        code, left = 255, 0
        for byte in encoded:
            if left:
                packet.append(byte)
                left -= 1
            else:
                if code != 255:
                    packet.append(0)
                code = byte
                left = byte - 1
        if left or not packet or len(packet) > arduino.MAX_PACKET:
            return None
        return self._message(bytes(packet))

    @staticmethod
    def _message(packet: bytes) -> Any:
        message_class = _KNOWN.get(packet[0])
        if message_class is None:
            return arduino.Log.unpack(packet[0], packet[1:]) if packet[0] < 4 else None
        if len(packet) - 1 != message_class.LAYOUT.size:
            return None
        message = message_class.unpack(packet[1:])
        implausible = getattr(message, 'implausible', None)
        return None if implausible and implausible() else message


class ByteBus(_ByteWise):
    """Flag, Datelen, CMD1, DATE, Checksum of a reply, a byte at a time."""

    def __init__(self) -> None:
        self._state = 'WAIT_FLAG'
        self._xor = 0
        self._length = 0
        self._cmd1 = 0
        self._data = bytearray()

    def _byte(self, byte: int) -> Any:
        state = self._state
        if state == 'WAIT_FLAG':
            if byte == bus.STANDARD_FLAG:
                self._state = 'READ_LENGTH'
            elif byte == bus.LONG_FLAG:
                self._state = 'READ_LOW'
            self._xor = byte
            return None
        if state == 'READ_CHECKSUM':
            self._state = 'WAIT_FLAG'
            return bus.Reply(self._cmd1, bytes(self._data)) if byte == self._xor else None
        self._xor ^= byte
        if state == 'READ_LENGTH':
            self._length = byte
            self._state = 'READ_CMD1' if byte < 255 else 'WAIT_FLAG'
        elif state == 'READ_LOW':
            self._length = byte
            self._state = 'READ_HIGH'
        elif state == 'READ_HIGH':
            self._length |= byte << 8
            self._state = 'READ_CMD1' if 255 <= self._length <= bus.MAX_LENGTH else 'WAIT_FLAG'
        elif state == 'READ_CMD1':
            self._cmd1 = byte
            self._data.clear()
            self._state = 'READ_DATE' if self._length else 'READ_CHECKSUM'
        else:
            self._data.append(byte)
            if len(self._data) == self._length:
                self._state = 'READ_CHECKSUM'
        return None


class Protocol(NamedTuple):
    """One protocol's two decoders and its traffic, frame by frame."""

    package: Callable[[], Any]
    bytewise: Callable[[], Any]
    clean: List[bytes]


def protocols() -> Dict[str, Protocol]:
    """By link."""
    # A polled environment, a motion now and then.
    replies = [bus.encode_reply(
        bus.Reply(bus.OK, bus.Environment(350 + n, 25.63, 48.12).pack() if n % 5 else b''))
        for n in range(250)]
    return {
        'arduino': Protocol(
            arduino.Decoder, ByteArduino,
            [packet for n in range(256) for _, packet in arduino_turn(n)]),
        'mcu': Protocol(
            mcu.Decoder, ByteMcu, [frame for n in range(256) for _, frame in mcu_turn(n)]),
        'bus': Protocol(bus.ReplyDecoder, ByteBus, replies),
    }


def read_in(frames: List[bytes], size: int) -> List[bytes]:
    """The frames as reads of `size` bytes; 0: each frame a read."""
    if not size:
        return frames
    stream = b''.join(frames)
    return [stream[at:at + size] for at in range(0, len(stream), size)]


def messages(decoder: Any, reads: List[bytes]) -> List[Any]:
    """The typed messages of good frames, whichever kind of decoder it is."""
    found = []
    for data in reads:
        for item in decoder.feed(data):
            if not hasattr(item, 'cause'):
                found.append(item)
            elif not item.cause:
                found.append(item.message)
    return found


def noise(frames: List[bytes], seed: int = 7) -> List[bytes]:
    """Clean traffic in which every eighth frame has a flipped bit, with garbage in between."""
    chance = random.Random(seed)
    noisy = []
    for frame in frames:
        if chance.random() < 0.125:
            place = chance.randrange(len(frame))
            frame = (frame[:place] + bytes((frame[place] ^ 1 << chance.randrange(8),))
                     + frame[place + 1:])
        if chance.random() < 0.125:
            frame = bytes(chance.randrange(256) for _ in range(chance.randrange(1, 24))) + frame
        noisy.append(frame)
    return noisy


def compare(protocol: Protocol, reads: List[bytes], seconds: float) -> Tuple[Speed, Speed]:
    """Both decoders in turns on the same reads for `seconds` in all: package, bytewise."""
    size = sum(map(len, reads))
    decoders = protocol.package(), protocol.bytewise()
    times: Tuple[List[float], List[float]] = ([], [])
    until = time.monotonic() + seconds
    while time.monotonic() < until or len(times[0]) < 3:
        for decoder, taken in zip(decoders, times):
            feed = decoder.feed
            start = time.perf_counter()
            for data in reads:
                feed(data)
            taken.append(time.perf_counter() - start)
    package, bytewise = (
        _speed(size, len(messages(make(), reads)), sorted(taken)[len(taken) // 2])
        for make, taken in zip((protocol.package, protocol.bytewise), times))
    return package, bytewise


def _speed(size: int, frames: int, seconds: float) -> Speed:
    return Speed(size / seconds / 1e6, frames / seconds,
                 seconds / frames * 1e6 if frames else None, frames)


def least(protocol: Protocol) -> float:
    """us a frame for its typed message and its record alone: what each decoder in Python takes.

    No search, no check, no COBS: the frames are known.
    """
    decoder = protocol.package()
    frames = [frame for data in protocol.clean for frame in decoder.feed(data)]
    plan = [(frame.raw, frame.type, frame.command, frame.data,
             partial(bus.Reply, frame.type) if isinstance(frame.message, bus.Reply)
             else type(frame.message).unpack) for frame in frames]
    times = []
    for _ in range(20):
        found = []
        start = time.perf_counter()
        for raw, type_, command, data, build in plan:
            found.append(Frame(raw, type_, command, data, build(data)))
        times.append(time.perf_counter() - start)
    return sorted(times)[len(times) // 2] / len(plan) * 1e6


def run(seconds: float) -> List[Decoding]:
    """Every protocol and every kind of stream; `seconds` for all of them."""
    costs = sorted(decoder_costs(1 << 16), key=lambda cost: -cost.worst)
    cases = [(link, protocol) + stream for link, protocol in protocols().items()
             for stream in _streams(protocol, [cost.name for cost in costs
                                               if cost.link == link][:_WORST])]
    floors = {link: least(protocol) for link, protocol in protocols().items()}
    rows = []
    for link, protocol, name, size, frames in cases:
        reads = read_in(frames, size)
        ours, theirs = compare(protocol, reads, seconds / len(cases))
        rows.append(Decoding(
            link, name, str(size or 'a frame'), ours, theirs, ours.mb_per_s / theirs.mb_per_s,
            theirs.us_per_frame / floors[link] if name == 'clean' else None,
            messages(protocol.package(), reads) == messages(protocol.bytewise(), reads)))
    return rows


def _streams(protocol: Protocol, worst: List[str]) -> List[Tuple[str, int, List[bytes]]]:
    """Each with its name and the size of its reads; all equally long.

    Args:
        worst: names of hostile streams.
    """
    frames = protocol.clean
    size = sum(map(len, frames))
    noisy = noise(frames)
    return [('clean', READ, frames), ('clean', 0, frames), ('noise', READ, noisy),
            ('noise', 0, noisy)] + [
                (stream.name, READ, [stream.worst]) for stream in worst_streams(size)
                if stream.decoder is protocol.package and stream.name in worst]
