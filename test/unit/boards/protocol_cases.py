"""Helpers for tests of decoders: the protocols, and all ways in which a stream may be read."""
import random
from typing import Any, Callable, Dict, Iterable, List, NamedTuple, Sequence, Tuple

from decoding import errors_of
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.bus import wire as bus
from serial_communication.framing.stream import Frame

_SEEDS = (1, 2, 3)      # of the random chunks


class DecoderKind(NamedTuple):
    """A decoder and the properties of its protocol."""

    name: str
    make: Callable[[], Any]
    longest: int          # bytes of the longest frame or packet, with its end
    quiet: bytes          # bytes with which no frame begins
    false_start: bytes    # the start of a frame that is never completed
    checksummed: bool     # whether frames inside damaged ones are found


BUS = DecoderKind('bus', bus.ReplyDecoder, 1029, b'\x00\x11\xff', b'\xa5\xc8', True)
BUS_CMD2 = DecoderKind('bus with CMD2 in replies', lambda: bus.ReplyDecoder(has_cmd2=True), 1030,
                       b'\x00\x11\xff', b'\xa5\xc8', True)
BOARD_BUS = DecoderKind('board side of bus', bus.RequestDecoder, 1030, b'\x00\x11\xff',
                        b'\xa5\xc8', True)
MCU = DecoderKind('mcu', mcu.Decoder, 259, b'\x00\x11\xff', b'\x02\xc8\x63', True)
ARDUINO = DecoderKind('arduino', lambda: arduino.Decoder(check_plausibility=False), 259,
                      b'\x11\xff\x07', b'', False)
ARDUINO_CHECKED = DecoderKind('arduino, values checked', arduino.Decoder, 259,
                              b'\x11\xff\x07', b'', False)
BOARD_ARDUINO = DecoderKind('board side of arduino', arduino.BoardDecoder, 259,
                            b'\x11\xff\x07', b'', False)

CHECKSUMMED = (BUS, BUS_CMD2, BOARD_BUS, MCU)
ALL = CHECKSUMMED + (ARDUINO, ARDUINO_CHECKED, BOARD_ARDUINO)


def name_of(kind: DecoderKind) -> str:
    """For pytest's ids."""
    return kind.name


def random_chunks(stream: bytes, seed: int) -> List[bytes]:
    """The stream in chunks of random sizes: mostly short, some long, some empty."""
    chance = random.Random(seed)
    chunks, at = [], 0
    while at < len(stream):
        size = chance.choice((0, 1, 1, 2, 3, 5, 8, 20, 100, 700))
        chunks.append(stream[at:at + size])
        at += size
    return chunks


def chunkings(stream: bytes) -> List[Sequence[bytes]]:
    """The stream in one chunk, byte by byte, and in random chunks."""
    bytewise = [stream[at:at + 1] for at in range(len(stream))]
    return [[stream], bytewise] + [random_chunks(stream, seed) for seed in _SEEDS]


def feed(decoder: Any, chunks: Iterable[bytes]) -> List[Frame]:
    """All frames, valid and invalid, of chunks that are fed one after the other."""
    return [frame for chunk in chunks for frame in decoder.feed(chunk)]


def give_up(decoder: Any) -> List[Frame]:
    """Call give_up() until nothing is pending, as a link does after its frame timeout."""
    frames: List[Frame] = []
    for _ in range(5000):
        if not decoder.pending:
            return frames
        frames += decoder.give_up()
    raise AssertionError('give_up() leaves bytes pending for ever')


def valid(frames: Iterable[Frame]) -> List[Frame]:
    """The valid frames, without what depends on the reads."""
    return [frame._replace(stamp=None, behind=0) for frame in frames if not frame.cause]


def decode(kind: DecoderKind, stream: bytes, end: bool = True) -> Tuple[List[Frame], dict]:
    """The valid frames of a stream, and how many errors of each cause there are.

    Checks that they do not depend on the chunks, and neither do the order, the causes and the
    bytes of invalid frames (except the bytes of a packet that is too long).

    Args:
        end: give up what is pending after the last byte.
    """
    outcomes = []
    for chunks in chunkings(stream):
        decoder = kind.make()
        frames = feed(decoder, chunks)
        if end:
            frames += give_up(decoder)
        check_reported(stream, frames)
        outcomes.append((valid(frames), {**no_errors(kind), **errors_of(frames)}, decoder.pending,
                         [(frame.cause, frame.raw if kind.checksummed else b'')
                          for frame in frames]))
    for other in outcomes[1:]:
        assert other == outcomes[0]
    return outcomes[0][:2]


def check_reported(stream: bytes, frames: Sequence[Frame]) -> None:
    """Check that the bytes of all frames are in the stream, in order, and that invalid ones have
    a cause and an error."""
    at = 0
    for frame in frames:
        found = stream.find(frame.raw.rstrip(b'\0') if frame.cause else frame.raw, at)
        assert found >= 0, 'the bytes of %r are not in the stream' % (frame,)
        at = found
        assert bool(frame.cause) == bool(frame.error)
        if frame.cause:
            assert frame.message is None


def check_case(kind: DecoderKind, wire: bytes, message: Any, type_: int, command: int = 0,
               data: bytes = b'') -> None:
    """Check that a valid frame is found: alone, twice, after noise, and with noise behind it.

    Each in all chunkings; the noise is counted as one error.
    """
    expected = Frame(wire, type_, command, data, message)
    assert decode(kind, wire, end=False) == ([expected], no_errors(kind))
    assert decode(kind, wire * 2, end=False) == ([expected] * 2, no_errors(kind))
    separator = b'' if kind.checksummed else b'\0'
    for garbage in kind.quiet, kind.quiet[:1], kind.quiet * 50:
        frames, errors = decode(kind, garbage + separator + wire)
        assert frames == [expected]
        assert sum(errors.values()) == 1
        frames, errors = decode(kind, wire + garbage + separator)
        assert frames == [expected]
        assert sum(errors.values()) == 1
        frames, errors = decode(kind, (garbage + separator + wire) * 2)
        assert frames == [expected] * 2
        assert sum(errors.values()) == 2
    if kind.false_start and len(wire) < 180:
        # The frame is inside an apparently longer one until that is given up.
        frames, errors = decode(kind, kind.false_start + wire)
        assert frames == [expected]
        assert sum(errors.values()) == 1


def check_rejected(kind: DecoderKind, wire: bytes, cause: str, **others: int) -> None:
    """Check that there is no frame, one error of this cause, and the given counts of others."""
    frames, errors = decode(kind, wire)
    assert frames == []
    assert errors == dict(no_errors(kind), **dict(others, **{cause: 1}))


def no_errors(kind: DecoderKind) -> Dict[str, int]:
    """The error counts of a new decoder."""
    return dict.fromkeys(kind.make().CAUSES, 0)


def held(decoder: Any) -> int:
    """The size of the largest buffer that a decoder keeps from one feed to the next."""
    sizes = [len(value) for value in vars(decoder).values()
             if hasattr(value, '__len__') and not isinstance(value, (list, dict))]
    return max(sizes, default=0)
