"""From a recording to the bytes that a board sent and the times at which to send them again.

A bridge on a desk is to make the same of them as the one on the robot did: the same messages, the
same counts of errors. A bag holds frames, not bytes, so:

- After a failed checksum a good frame may begin inside a bad one: their bytes overlap, and are
  sent once.
- Of a stretch of noise a bag quotes what was there when it was noticed. Where that alone looks
  like a beginning, bytes are added with which it is noise again.
- A link drops an incomplete frame when `frame_timeout` passes without a byte, which changes what
  it makes of the bytes that follow. Where such a silence was hardly longer, or hardly shorter,
  than that (a sensor board at 20 Hz that lost the end of a frame: 50 ms), a bridge on a desk
  might decide otherwise. So the bytes of the incomplete frame, which say nothing, are sent a
  little earlier or later than they came.
"""
import copy
from collections import Counter
from math import inf
from typing import Any, Iterable, List, NamedTuple, Sequence, Tuple

from ...framing.stream import CHECKSUM, FRAMING, MAX_REPORTED, OVERSIZE, Frame
from .lines import Direction, Settings, decoder
from .recording import Read, Recording, Seen, decoded

_LONGEST = 300     # bytes of a frame that is filled up; a bus frame is longer, but not its header
_MARGIN = 0.5      # of frame_timeout, by which a silence is to be longer or shorter than it


class Piece(NamedTuple):
    """Bytes to be sent in one write."""

    at: float           # s since the recording's start
    data: bytes
    given_up: bool      # what is incomplete behind it was given up before anything else came


def pieces_of(recording: Recording, line: Settings) -> List[Piece]:
    """What the board sent, piece by piece, as it came."""
    reads = [read for read in recording.reads.get(line.link, []) if not read.sent]
    if reads:
        return [Piece(read.at, read.data, after.at - read.at > line.frame_timeout)
                for read, after in zip(reads, reads[1:])] + [Piece(*_last(reads[-1]))]
    return _as_read(_from_frames(frames_of(recording, line)), line)


def _last(read: Read) -> Tuple[float, bytes, bool]:
    return read.at, read.data, True


def frames_of(recording: Recording, line: Settings) -> List[Seen]:
    """The frames, good and bad, that the board sent, as they were recorded."""
    if line.link in recording.reads:
        return decoded([read for read in recording.reads[line.link] if not read.sent], line)
    return [each for each in recording.seen if each.link == line.link and not each.sent]


# -- from frames to bytes -------------------------------------------------------------------


class _Bytes:
    """The stream as it is put together: each frame is laid where it must have stood."""

    def __init__(self) -> None:
        self.stream = bytearray()
        self._next = 0       # where the frame after the latest one begins …
        self._first = 0      # … unless it is a good one: from here on, inside a bad one

    def lay(self, frame: Frame) -> Tuple[int, bytes]:
        """Where in the stream this frame begins, and the bytes that it adds to it."""
        raw, before = _sent_as(frame), len(self.stream)
        start = self._next
        if not frame.cause:
            start = next((at for at in range(self._first, self._next + 1)
                          if self._fits(raw, at)), self._next)
        if not self._fits(raw, start):
            start = before
        self.stream += raw[before - start:] if before > start else raw
        self._next = start + len(raw)
        self._first = start + 1 if frame.cause == CHECKSUM else self._next
        return start, bytes(self.stream[before:])

    def _fits(self, raw: bytes, start: int) -> bool:
        known = self.stream[start:start + len(raw)]
        return raw[:len(known)] == known


def _sent_as(frame: Frame) -> bytes:
    """A packet that was too long is recorded without the 0x00 that ended it."""
    if frame.cause == OVERSIZE and not frame.raw.endswith(b'\0'):
        return frame.raw + b'\0'
    return frame.raw


class _Laid(NamedTuple):
    """The bytes of one read, as far as frames tell of them."""

    at: float
    data: bytes
    decided: bool      # what all of them are was known before anything else came
    noise_from: int    # where in the stream the noise begins that they end with
    delay: float       # s until the last of them was told


def _from_frames(seen: Sequence[Seen]) -> List[_Laid]:
    """A frame's stamp is that of the read that completed it, a bad one's of the latest read when
    it was decided: its bytes came no later than the next good frame's."""
    came = [each.frame.stamp for each in seen]
    for index in range(len(came) - 2, -1, -1):
        came[index] = min(came[index], came[index + 1])
    stream = _Bytes()
    laid: List[_Laid] = []
    decided = 0.0          # the latest stamp so far: when all up to here was decided
    for (_, _, frame, delay), at in zip(seen, came):
        decided = max(decided, frame.stamp)
        start, data = stream.lay(frame)
        if laid and start + len(data) < len(stream.stream) and frame.stamp > laid[-1].at:
            # Bytes that were sent before are this frame's as well: they waited for it.
            laid[-1] = laid[-1]._replace(decided=False)
        if laid and laid[-1].at == at:
            data = laid.pop().data + data
        laid.append(_Laid(at, data, decided <= at,
                          start if frame.cause == FRAMING else len(stream.stream), delay))
    return laid


def _as_read(laid: List[_Laid], line: Settings) -> List[Piece]:
    """The same, with the noise that no frame quotes, where it takes such bytes.

    Of a stretch of noise a bag has what was read when it was noticed. What that ends with may look
    like a beginning, and yet have been known for noise at once: then bytes behind it told. Where
    it was given up instead, it was told later by `frame_timeout`.
    """
    check = decoder(line, False)
    pieces: List[Piece] = []
    sent = 0      # bytes that frames quote, and others
    added = 0     # of these, the others
    nothing = _Laid(inf, b'', True, 0, inf)
    for (at, data, decided, noise_from, delay), after in zip(laid, laid[1:] + [nothing]):
        check.feed(data)
        sent += len(data)
        was_silent = after.at - at >= line.frame_timeout
        if (decided and check.pending and check.front >= noise_from + added
                and not (was_silent and delay > line.frame_timeout * _MARGIN)):
            filler = _filler(check, sent)
            check.feed(filler)
            data += filler
            sent += len(filler)
            added += len(filler)
        given_up = decided and was_silent
        if given_up:
            _fall_silent(check)
        pieces.append(Piece(at, data, given_up))
    return pieces


def _fall_silent(check: Any) -> List[Frame]:
    """No byte comes for long: what is incomplete is given up, and noise is a damage of its own."""
    frames: List[Frame] = []
    while check.pending:
        frames += check.give_up()
    return frames


def _filler(check: Any, sent: int) -> bytes:
    """The fewest bytes that make noise of all that is pending, and are no other error."""
    found = []
    for byte in b'\0', b'\xff':
        other = copy.deepcopy(check)
        size = 0
        while other.pending and other.front < sent and size < _LONGEST:
            other.feed(byte)
            size += 1
        if not other.pending and all(count == check.errors[cause] for cause, count
                                     in other.errors.items() if cause != FRAMING):
            found.append(byte * size)
    return min(found, key=len, default=b'')


# -- times ----------------------------------------------------------------------------------


def spaced(pieces: Sequence[Piece], line: Settings, rate: float = 1.0) -> List[Piece]:
    """The same at `rate` times the speed, with silences that leave no doubt: see the module."""
    check = decoder(line, False)
    longer = line.frame_timeout * (1 + _MARGIN)
    shorter = line.frame_timeout * (1 - _MARGIN)
    times = [piece.at / rate for piece in pieces]
    floor = 0.0            # no piece before this, so that what was given up before it still is
    is_open = False        # what comes next may be taken for a part of what came last
    for index, piece in enumerate(pieces):
        at = max(times[index], floor)
        after = times[index + 1] if index + 1 < len(pieces) else inf
        frames = check.feed(piece.data)
        if frames:
            is_open = frames[-1].cause == FRAMING
        if piece.given_up:
            if check.pending or is_open:
                at = max(min(at, after - longer), floor)
                floor = at + longer
            else:
                floor = at
            _fall_silent(check)
            is_open = False
        else:
            if (check.pending or is_open) and after - at > shorter:
                at = after - shorter
            floor = at
        times[index] = at
    return [piece._replace(at=at) for piece, at in zip(pieces, times)]


def differences(seen: Sequence[Seen], pieces: Iterable[Piece], line: Settings) -> int:
    """How many frames, noise aside, do not come out of these pieces as they were recorded."""
    direction = Direction(line, False)
    again: List[Frame] = []
    for piece in pieces:
        again += direction.hear(piece.data, piece.at)
    again += direction.silent_until(inf)
    # Not how noise is cut into stretches: that depends on when somebody looked at it.
    wanted, found = ([(frame.raw, frame.cause if frame.cause in (CHECKSUM, OVERSIZE) else '')
                      for frame in frames if frame.cause != FRAMING]
                     for frames in ([each.frame for each in seen], again))
    if wanted == found:
        return 0
    return max(sum((Counter(wanted) - Counter(found)).values()),
               sum((Counter(found) - Counter(wanted)).values()), 1)


def cut_off(seen: Iterable[Seen]) -> int:
    """How many stretches of noise are longer than a bag keeps of one."""
    return sum(bool(each.frame.cause) and len(each.frame.raw) >= MAX_REPORTED for each in seen)
