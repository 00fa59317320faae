"""What every decoder test shares: the ways in which one stream of bytes may arrive."""
import json
import os
import random
from collections import Counter
from typing import Any, Callable, Dict, Iterable, List, NamedTuple, Sequence, Tuple

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.bus import wire as bus
from serial_communication.framing.stream import UNKNOWN, Frame

_SEEDS = (1, 2, 3)      # of the random chunks


class DecoderKind(NamedTuple):
    """A decoder, and what the tests must know of its wire."""

    name: str
    make: Callable[[], Any]
    longest: int          # bytes of the longest frame or packet, its end included
    quiet: bytes          # bytes that begin no frame
    false_start: bytes    # bytes that begin one, and keep a decoder waiting
    checksummed: bool     # whether it finds frames inside damaged ones


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


def vectors(protocol: str) -> Dict[str, List[dict]]:
    """The byte-exact examples of one protocol."""
    path = os.path.join(os.path.dirname(__file__), '..', 'boards', 'vectors',
                        protocol + '.json')
    with open(path, encoding='utf-8') as file:
        return json.load(file)


def hexed(text: str) -> bytes:
    """Bytes from the vectors' notation."""
    return bytes.fromhex(text)


def random_chunks(stream: bytes, seed: int) -> List[bytes]:
    """The stream in pieces: mostly short, some long, some empty."""
    chance = random.Random(seed)
    chunks, at = [], 0
    while at < len(stream):
        size = chance.choice((0, 1, 1, 2, 3, 5, 8, 20, 100, 700))
        chunks.append(stream[at:at + size])
        at += size
    return chunks


def chunkings(stream: bytes) -> List[Sequence[bytes]]:
    """Whole, byte by byte, and in random chunks."""
    bytewise = [stream[at:at + 1] for at in range(len(stream))]
    return [[stream], bytewise] + [random_chunks(stream, seed) for seed in _SEEDS]


def feed(decoder: Any, chunks: Iterable[bytes]) -> List[Frame]:
    """All frames, good and bad, of chunks fed one after the other."""
    return [frame for chunk in chunks for frame in decoder.feed(chunk)]


def give_up(decoder: Any) -> List[Frame]:
    """What a link does when no more bytes come: until nothing is pending."""
    frames: List[Frame] = []
    for _ in range(5000):
        if not decoder.pending:
            return frames
        frames += decoder.give_up()
    raise AssertionError('give_up() does not come to an end')


def good(frames: Iterable[Frame]) -> List[Frame]:
    """The good ones, without their stamps."""
    return [frame._replace(stamp=None) for frame in frames if not frame.cause]


def decode(kind: DecoderKind, stream: bytes, end: bool = True) -> Tuple[List[Frame], dict]:
    """Good frames and error counts of a stream, which do not depend on its chunking.

    Neither does where among the good frames the bad ones stand, of which cause they are, or which
    bytes they quote (but for a packet that is too long). With `end`, what is still pending behind
    the last byte is given up.
    """
    outcomes = []
    for chunks in chunkings(stream):
        decoder = kind.make()
        frames = feed(decoder, chunks)
        if end:
            frames += give_up(decoder)
        check_reported(stream, frames)
        check_counted(kind, frames, decoder.errors)
        outcomes.append((good(frames), dict(decoder.errors), decoder.pending,
                         [(frame.cause, frame.raw if kind.checksummed else b'')
                          for frame in frames]))
    for other in outcomes[1:]:
        assert other == outcomes[0]
    return outcomes[0][:2]


def check_reported(stream: bytes, frames: Sequence[Frame]) -> None:
    """Every frame's bytes stand in the stream, in order; a bad one says why it is bad."""
    at = 0
    for frame in frames:
        found = stream.find(frame.raw.rstrip(b'\0') if frame.cause else frame.raw, at)
        assert found >= 0, 'the bytes of %r are not in the stream' % (frame,)
        at = found
        assert bool(frame.cause) == bool(frame.error)
        if frame.cause:
            assert frame.message is None


def check_counted(kind: DecoderKind, frames: Iterable[Frame], errors: Dict[str, int]) -> None:
    """One bad frame for each error. (An mcu frame of an unknown type is a good one.)"""
    shown = Counter(frame.cause for frame in frames if frame.cause)
    assert shown == Counter({cause: count for cause, count in errors.items()
                             if count and not (kind is MCU and cause == UNKNOWN)})


def total(errors: Dict[str, int]) -> int:
    """Errors of all causes."""
    return sum(errors.values())


def check_case(kind: DecoderKind, wire: bytes, message: Any, type_: int, command: int = 0,
               data: bytes = b'') -> None:
    """One good frame: alone, twice, after garbage, and with bytes behind it.

    Each in every chunking, with the same frame and the errors that are the garbage's own.
    """
    expected = Frame(wire, type_, command, data, message)
    assert decode(kind, wire, end=False) == ([expected], no_errors(kind))
    assert decode(kind, wire * 2, end=False) == ([expected] * 2, no_errors(kind))
    separator = b'' if kind.checksummed else b'\0'
    for garbage in garbage_before(kind):
        frames, errors = decode(kind, garbage + separator + wire)
        assert frames == [expected]
        assert total(errors) == 1
        frames, errors = decode(kind, wire + garbage + separator)
        assert frames == [expected]
        assert total(errors) == 1
        frames, errors = decode(kind, garbage + separator + wire + garbage + separator + wire)
        assert frames == [expected] * 2
        assert total(errors) == 2
    if kind.false_start:
        # The frame stands inside what looks like a longer one, until that is given up.
        frames, errors = decode(kind, kind.false_start + wire)
        if len(wire) < 180:
            assert frames == [expected]
            assert total(errors) == 1


def garbage_before(kind: DecoderKind) -> List[bytes]:
    """Damage that counts as one error and cannot begin a frame."""
    return [kind.quiet, kind.quiet[:1], kind.quiet * 50]


def check_rejected(kind: DecoderKind, wire: bytes, cause: str, **others: int) -> None:
    """No frame, and exactly one error of this cause besides the others'."""
    frames, errors = decode(kind, wire)
    assert frames == []
    assert errors == dict(no_errors(kind), **dict(others, **{cause: 1}))


def no_errors(kind: DecoderKind) -> Dict[str, int]:
    """The counts of a decoder that has seen nothing."""
    return dict(kind.make().errors)


def held(decoder: Any) -> int:
    """Bytes and stamps that a decoder keeps from one feed to the next."""
    sizes = [len(value) for value in vars(decoder).values()
             if hasattr(value, '__len__') and not isinstance(value, (list, dict))]
    return max(sizes, default=0)
