"""From a recording to the bytes that a board sent, and the times at which to send them again.

The bridge that receives them should decode the same frames as the recorded one did. A bag holds
frames, not bytes. They are sent in order, with these exceptions:

- After a failed checksum a valid frame may begin inside an invalid one. Bytes of both are sent
  once.
- A bag has only a part of a packet that was too long. Such a packet is left out.
- A link drops an incomplete frame after `frame_timeout` without a byte, which changes how it
  decodes the bytes that follow. If the recorded silence was about as long (a sensor board at 20 Hz
  that lost the end of a frame: 50 ms), the receiving bridge might decide differently. So the bytes
  of the incomplete frame are sent a little earlier or later than recorded.
"""
from collections import Counter
from math import inf
from typing import Iterable, List, NamedTuple, Sequence, Tuple

from ...framing.stream import CHECKSUM, FRAMING, OVERSIZE, Frame
from .lines import Direction, Settings, decoder
from .recording import Recording

_MARGIN = 0.5      # in frame_timeouts; a silence is made longer or shorter than one by this


class Piece(NamedTuple):
    """Bytes to send in one write."""

    at: float           # s since the recording's start
    data: bytes
    given_up: bool      # a frame that is incomplete after it was dropped before the next byte


def pieces_of(recording: Recording, frames: Iterable[Frame], line: Settings) -> List[Piece]:
    """Return what the board sent at the recorded times; `frames` are those from the board."""
    reads = [read for read in recording.reads.get(line.link, []) if not read.sent]
    pieces = [Piece(read.at, read.data, True) for read in reads] if reads else _from_frames(
        [frame for frame in frames if is_complete(frame, line)])
    return [piece._replace(given_up=piece.given_up and after - piece.at >= line.frame_timeout)
            for piece, after in zip(pieces, [piece.at for piece in pieces[1:]] + [inf])]


def is_complete(frame: Frame, line: Settings) -> bool:
    """Whether a bag has all bytes of a frame. Of a packet that was too long it has the first."""
    return frame.cause != OVERSIZE or frame.raw[-1] in line.board.between


# -- from frames to bytes -------------------------------------------------------------------


class _Stream:
    """Rebuilds the stream: places each frame where it must have been."""

    def __init__(self) -> None:
        self.data = bytearray()
        self._next = 0       # where the next frame begins, except that …
        self._first = 0      # … a valid one may begin from here on, inside an invalid one

    def place(self, frame: Frame) -> Tuple[int, bytes]:
        """Place a frame. Return where in the stream it begins, and the bytes that it adds."""
        raw, before = frame.raw, len(self.data)
        start = self._next
        if not frame.cause:
            start = next((at for at in range(self._first, self._next + 1)
                          if self._fits(raw, at)), self._next)
        if not self._fits(raw, start):
            start = before
        self.data += raw[before - start:] if before > start else raw
        self._next = start + len(raw)
        self._first = start + 1 if frame.cause == CHECKSUM else self._next
        return start, bytes(self.data[before:])

    def _fits(self, raw: bytes, start: int) -> bool:
        known = self.data[start:start + len(raw)]
        return raw[:len(known)] == known


def _from_frames(frames: Sequence[Frame]) -> List[Piece]:
    """The pieces of a bag.

    The stamp of a valid frame is that of the read that completed it, of an invalid one that of the
    read in which it was detected. The bytes of an invalid frame were received no later than those
    of the next valid one.
    """
    received_at = [frame.stamp for frame in frames]
    for index in range(len(received_at) - 2, -1, -1):
        received_at[index] = min(received_at[index], received_at[index + 1])
    stream = _Stream()
    pieces: List[Piece] = []
    decided = 0.0          # the latest stamp so far: every frame up to here was decided by then
    for frame, at in zip(frames, received_at):
        decided = max(decided, frame.stamp)
        start, data = stream.place(frame)
        if pieces and start + len(data) < len(stream.data) and frame.stamp > pieces[-1].at:
            # This frame also has bytes of the last piece, which waited for it.
            pieces[-1] = pieces[-1]._replace(given_up=False)
        if pieces and pieces[-1].at == at:
            data = pieces.pop().data + data
        pieces.append(Piece(at, data, decided <= at))
    return pieces


# -- times ----------------------------------------------------------------------------------


def spaced(pieces: Sequence[Piece], line: Settings, rate: float = 1.0) -> List[Piece]:
    """Return the pieces at `rate` times the speed, moved so that no silence is about as long as
    `frame_timeout`: see the module."""
    check = decoder(line, False)
    longer = line.frame_timeout * (1 + _MARGIN)
    shorter = line.frame_timeout * (1 - _MARGIN)
    times = [piece.at / rate for piece in pieces]
    earliest = 0.0         # for the next piece, so that an incomplete frame before it times out
    is_open = False        # the next bytes may be taken for a part of the last ones
    for index, piece in enumerate(pieces):
        at = max(times[index], earliest)
        after = times[index + 1] if index + 1 < len(pieces) else inf
        frames = check.feed(piece.data)
        if frames:
            is_open = frames[-1].cause == FRAMING
        if piece.given_up:
            if check.pending or is_open:
                at = max(min(at, after - longer), earliest)
                earliest = at + longer
            else:
                earliest = at
            while check.pending:
                check.give_up()
            is_open = False
        else:
            if (check.pending or is_open) and after - at > shorter:
                at = after - shorter
            earliest = at
        times[index] = at
    return [piece._replace(at=at) for piece, at in zip(pieces, times)]


def differences(frames: Iterable[Frame], pieces: Iterable[Piece], line: Settings) -> int:
    """Return how many frames, noise aside, are decoded from the pieces other than recorded."""
    direction = Direction(line, False)
    again: List[Frame] = []
    for piece in pieces:
        again += direction.feed(piece.data, piece.at)
    again += direction.expire(inf)
    # How noise is split into frames depends on when the bytes were decoded, so it is left out.
    wanted, found = ([(frame.raw, frame.cause if frame.cause in (CHECKSUM, OVERSIZE) else '')
                      for frame in decoded if frame.cause != FRAMING and is_complete(frame, line)]
                     for decoded in (frames, again))
    if wanted == found:
        return 0
    return max(sum((Counter(wanted) - Counter(found)).values()),
               sum((Counter(found) - Counter(wanted)).values()), 1)
