"""From a recording to the bytes that a board sent and the times at which to send them again.

A bridge on a desk is to make the same of them as the one on the robot did. A bag holds frames, not
bytes, and its frames are sent as they stand in it:

- After a failed checksum a good frame may begin inside a bad one: their bytes overlap, and are
  sent once.
- Of a packet that was too long a bag has a part only. It is left out.
- A link drops an incomplete frame when `frame_timeout` passes without a byte, which changes what
  it makes of the bytes that follow. Where such a silence was hardly longer, or hardly shorter,
  than that (a sensor board at 20 Hz that lost the end of a frame: 50 ms), a bridge on a desk
  might decide otherwise. So the bytes of the incomplete frame, which say nothing, are sent a
  little earlier or later than they came.
"""
from collections import Counter
from math import inf
from typing import Iterable, List, NamedTuple, Sequence, Tuple

from ...framing.stream import CHECKSUM, FRAMING, OVERSIZE, Frame
from .lines import Direction, Settings, decoder
from .recording import Recording

_MARGIN = 0.5      # of frame_timeout, by which a silence is to be longer or shorter than it


class Piece(NamedTuple):
    """Bytes to be sent in one write."""

    at: float           # s since the recording's start
    data: bytes
    given_up: bool      # what is incomplete behind it was given up before anything else came


def pieces_of(recording: Recording, frames: Iterable[Frame], line: Settings) -> List[Piece]:
    """What the board sent, piece by piece, as it came; `frames` are those of the board."""
    reads = [read for read in recording.reads.get(line.link, []) if not read.sent]
    pieces = [Piece(read.at, read.data, True) for read in reads] if reads else _from_frames(
        [frame for frame in frames if is_whole(frame, line)])
    return [piece._replace(given_up=piece.given_up and after - piece.at >= line.frame_timeout)
            for piece, after in zip(pieces, [piece.at for piece in pieces[1:]] + [inf])]


def is_whole(frame: Frame, line: Settings) -> bool:
    """Whether a bag has all of its bytes: of a packet that was too long it has the first ones."""
    return frame.cause != OVERSIZE or frame.raw[-1] in line.board.between


# -- from frames to bytes -------------------------------------------------------------------


class _Bytes:
    """The stream as it is put together: each frame is laid where it must have stood."""

    def __init__(self) -> None:
        self.stream = bytearray()
        self._next = 0       # where the frame after the latest one begins …
        self._first = 0      # … unless it is a good one: from here on, inside a bad one

    def lay(self, frame: Frame) -> Tuple[int, bytes]:
        """Where in the stream this frame begins, and the bytes that it adds to it."""
        raw, before = frame.raw, len(self.stream)
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


def _from_frames(frames: Sequence[Frame]) -> List[Piece]:
    """A frame's stamp is that of the read that completed it, a bad one's of the latest read when
    it was decided: its bytes came no later than the next good frame's."""
    came = [frame.stamp for frame in frames]
    for index in range(len(came) - 2, -1, -1):
        came[index] = min(came[index], came[index + 1])
    stream = _Bytes()
    pieces: List[Piece] = []
    decided = 0.0          # the latest stamp so far: when all up to here was decided
    for frame, at in zip(frames, came):
        decided = max(decided, frame.stamp)
        start, data = stream.lay(frame)
        if pieces and start + len(data) < len(stream.stream) and frame.stamp > pieces[-1].at:
            # Bytes that were sent before are this frame's as well: they waited for it.
            pieces[-1] = pieces[-1]._replace(given_up=False)
        if pieces and pieces[-1].at == at:
            data = pieces.pop().data + data
        pieces.append(Piece(at, data, decided <= at))
    return pieces


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
            while check.pending:
                check.give_up()
            is_open = False
        else:
            if (check.pending or is_open) and after - at > shorter:
                at = after - shorter
            floor = at
        times[index] = at
    return [piece._replace(at=at) for piece, at in zip(pieces, times)]


def differences(frames: Iterable[Frame], pieces: Iterable[Piece], line: Settings) -> int:
    """How many frames, noise aside, do not come out of these pieces as they were recorded."""
    direction = Direction(line, False)
    again: List[Frame] = []
    for piece in pieces:
        again += direction.hear(piece.data, piece.at)
    again += direction.silent_until(inf)
    # Not how noise is cut into stretches: that depends on when somebody looked at it.
    wanted, found = ([(frame.raw, frame.cause if frame.cause in (CHECKSUM, OVERSIZE) else '')
                      for frame in told if frame.cause != FRAMING and is_whole(frame, line)]
                     for told in (frames, again))
    if wanted == found:
        return 0
    return max(sum((Counter(wanted) - Counter(found)).values()),
               sum((Counter(found) - Counter(wanted)).values()), 1)
