"""Finding checksummed frames in a byte stream, at a cost that is linear in the bytes.

Strategy: all bytes not yet decided stand in one buffer, and beside each of them the XOR of
every byte received so far. The XOR of any stretch is then that of two numbers, however long
the stretch is and however many false starts lie in it. A failed check moves the search on by
one byte, not past the false frame, so a valid frame that begins inside is found. A byte with
which a frame could begin, but none does, is a *false start*. A frame that had to wait behind one
keeps the stamp of the read that brought its own last byte. What stands in no frame is noise, which
is returned when it ends.
"""
import re
from bisect import bisect_left
from collections import deque
from copy import copy
from functools import partial
from typing import Any, Deque, Dict, List, NamedTuple, Protocol, Tuple

from .parts import Part, Parts

CHECKSUM = 'checksum'        # a whole frame whose checksum does not match
FRAMING = 'framing'          # bytes that are no frame: noise, a false length, a frame cut short
LENGTH = 'length'            # a known type with a length that is not its own
UNKNOWN = 'unknown type'     # a valid frame of a type that is not known here
IMPLAUSIBLE = 'implausible'  # a valid packet whose values cannot be
OVERSIZE = 'oversize'        # a packet longer than any packet may be

MAX_REPORTED = 1100  # longest `raw` of a bad frame, in bytes; longer than any valid frame


class Frame(NamedTuple):
    """One frame or packet as it crossed the wire, or a stretch of bytes that is none."""

    raw: bytes          # as on the wire
    type: int           # CMD1, message type or TYPE
    command: int        # CMD2 of a request, SEQ of an mcu frame, else 0
    data: bytes         # the payload, decoded
    message: Any        # the typed message; None where there is none
    stamp: Any = None   # what `feed` was given with the frame's last byte
    cause: str = ''     # empty for a good frame, else one of the causes above
    error: str = ''     # the cause in words

    @property
    def text(self) -> str:
        """What it says, in one line for a person."""
        if self.message is not None:
            return str(self.message)
        if self.cause:
            return f'{len(self.raw)} bytes refused'
        return f'a frame of type 0x{self.type:02x}, which is not known here'

    @property
    def trouble(self) -> str:
        """The cause and its words; empty for a good frame."""
        return f'{self.cause}: {self.error}' if self.cause else ''


# A `Frame` of a tuple with all its fields: half the time of calling the class, for every frame.
frame_of = partial(tuple.__new__, Frame)


def bad_frame(raw: bytes, cause: str, error: str, stamp: Any = None, type_: int = 0,
              data: bytes = b'') -> Frame:
    """A `Frame` that says what was wrong with `raw`."""
    return frame_of((raw[:MAX_REPORTED], type_, 0, data, None, stamp, cause, error))


class Decoder(Protocol):
    """What a decoder must be: bytes in, frames out, whatever comes, and without a clock.

    The frames do not depend on how the bytes are cut into reads. Nothing raises, nothing grows
    without bound, and every error is counted once and shown as one frame with a cause.
    """

    errors: Dict[str, int]     # by cause; `FRAMING` is one of them
    pending: bool              # whether there are bytes that no frame has been returned of
    begun: bool                # whether a frame has begun and is not complete
    front: int                 # where in the stream it begins, in bytes received before it
    needed: int                # how many bytes it has, as far as is known

    def feed(self, data: bytes, stamp: Any = None) -> List[Frame]:
        """Take bytes as they were read; return the frames, good and bad, now complete."""

    def give_up(self) -> List[Frame]:
        """No byte has come for too long: what has begun stays incomplete, and noise has ended. To
        be called until nothing is pending."""

    def skip_false_start(self) -> List[Frame]:
        """Bytes keep coming, but what is pending takes too long."""

    def reset(self) -> None:
        """Forget what is pending, as after a reconnect; the counts stay."""

    def explain(self, frame: bytes) -> List[Part]:
        """The parts of one frame; all its bytes as one, unless a decoder knows more."""
        return Parts(frame).take_rest('frame', '')


_PIECE = 4096        # bytes whose XORs are worked out at once


def running_xor(data: bytes, before: int) -> bytes:
    """For each byte of `data`, the XOR of `before` and every byte up to and including it.

    Doubling shifts of one long integer take log2(n) steps instead of n.
    """
    if len(data) > _PIECE:
        pieces = []
        for at in range(0, len(data), _PIECE):
            pieces.append(running_xor(data[at:at + _PIECE], before))
            before = pieces[-1][-1]
        return b''.join(pieces)
    size = len(data)
    value = int.from_bytes(data, 'little') ^ before
    bits, shift = size * 8, 8
    while shift < bits:
        value ^= value << shift
        shift *= 2
    return (value & ((1 << bits) - 1)).to_bytes(size, 'little')


class Good(NamedTuple):
    """A valid frame begins there: its size, and what `Frame` says of it."""

    size: int
    type: int
    command: int
    data: bytes
    message: Any         # None: of a type that is not known
    cause: str = ''      # why its message is refused all the same; '': it is not
    error: str = ''


class Bad(NamedTuple):
    """No frame begins there. With the cause `FRAMING` the byte is noise, whatever follows."""

    size: int            # of the whole frame that it looks like
    cause: str
    error: str


NO_FRAME = Bad(1, FRAMING, 'no frame begins so')


class Need(NamedTuple):
    """A frame may begin there."""

    size: int            # how many bytes from its first one are needed to tell more


class StreamDecoder:
    """The buffer, the counting and the resynchronising that checksummed framings share.

    A subclass says with which bytes a frame may begin (`STARTS`) and what begins at such a byte
    (`frame_at`), which only looks: at `buffer`, and at checksums by `xor`.

    Each error is one bad frame, in whatever pieces its bytes are read: a whole frame with a false
    checksum, or a stretch of noise, which ends where a frame begins, with a silence (`give_up`) or
    after `MAX_REPORTED` bytes.
    """

    STARTS = b''

    def __init__(self) -> None:
        self.errors: Dict[str, int] = {CHECKSUM: 0, FRAMING: 0}
        self._any_start = re.compile(b'[' + re.escape(self.STARTS) + b']')
        self.buffer = b''          # bytes that are not decided yet
        self._xors = b'\0'         # XOR of all bytes ever received before each of them, and now
        self._need = 1             # bytes in the buffer before searching on makes sense
        self._offset = 0           # bytes received before the buffer's first
        self._reads: Deque[Tuple[int, Any]] = deque()   # of the buffer's: (bytes received, stamp)
        self._frames: List[Frame] = []
        self._noise = b''          # that has not ended yet
        self._noise_stamp: Any = None    # of its last byte
        self._sorted = 0           # bytes received up to the latest that stands in a frame or noise

    @property
    def pending(self) -> bool:
        """Whether there are bytes that no frame has been returned of."""
        return bool(self.buffer or self._noise)

    @property
    def begun(self) -> bool:
        """Whether a frame has begun and is not complete."""
        return bool(self.buffer)

    @property
    def front(self) -> int:
        """Where in the stream that frame begins, in bytes received before it."""
        return self._offset

    @property
    def needed(self) -> int:
        """How many bytes that frame has, as far as is known yet."""
        return self._need

    def feed(self, data: bytes, stamp: Any = None) -> List[Frame]:
        """Take bytes as they were read; return the frames, good and bad, now complete."""
        if not data:
            return []
        self.buffer += data
        self._xors += running_xor(data, self._xors[-1])
        self._reads.append((self._offset + len(self.buffer), stamp))
        if len(self.buffer) < self._need:
            return []
        return self._search(0)

    def give_up(self) -> List[Frame]:
        """The frame at the front stays incomplete: go on at the byte after its first. Where no
        other one has begun there, noise has ended."""
        frames = self._search(1 if self.buffer else 0)
        if not self.buffer:
            self._end_noise(0)
        return frames

    def skip_false_start(self) -> List[Frame]:
        """The frame at the front takes too long: give it up if a valid one waits behind its start.

        Else a false length would delay valid frames for as long as others follow them.
        """
        frames: List[Frame] = []
        if any(byte in self.STARTS and isinstance(self.frame_at(at), Good)
               for at, byte in enumerate(self.buffer) if at):
            while all(frame.cause for frame in frames):
                frames += self.give_up()
        return frames

    def reset(self) -> None:
        """Forget what is pending, as after a reconnect; the counts stay."""
        errors = self.errors
        StreamDecoder.__init__(self)
        self.errors = errors

    # -- for subclasses ---------------------------------------------------------------

    def frame_at(self, at: int) -> Any:
        """What begins at this index, where one of `STARTS` is: `Good`, `Bad` or `Need`."""
        raise NotImplementedError

    def explain(self, frame: bytes) -> List[Part]:
        """The parts of one frame: what stands before its payload, the payload, and what follows.

        A decoder that knows more overrides it.
        """
        apart = copy(self)      # neither what is pending here nor the counts change
        apart.errors = dict(self.errors)
        apart.reset()
        frames, parts = apart.feed(frame), Parts(frame)
        if not apart.begun:
            frames += apart.give_up()
        if not frames:
            if frame:
                parts.take_bytes(apart.front + apart.needed, 'frame')
            return parts.found
        first = frames[0]
        start, payload, end = first.raw.partition(first.data) if first.data else \
            (first.raw, b'', b'')
        parts.take_bytes(len(start), 'start' if payload else 'frame',
                         error='' if payload else first.error)
        if payload:
            parts.take_bytes(len(payload), 'payload', str(first.message or ''), first.error)
        if end:
            parts.take_bytes(len(end), 'end')
        return parts.take_rest('more', 'does not belong to the frame')

    def xor(self, start: int, end: int) -> int:
        """The XOR of buffer[start:end]."""
        return self._xors[start] ^ self._xors[end]

    # -- the search -------------------------------------------------------------------

    def _search(self, at: int) -> List[Frame]:
        """Decide from buffer[at] on as far as that can be; before it no frame begins."""
        self._frames = frames = []
        buffer, size = self.buffer, len(self.buffer)
        need = 1
        while at < size:
            if buffer[at] not in self.STARTS:
                start = self._any_start.search(buffer, at)
                at = start.start() if start else size
                continue
            found = self.frame_at(at)
            kind = type(found)
            if kind is Good:
                self._add(at, found)
                # Its LEN may be false all the same: an XOR does not see whole frames in it.
                at += 1 if found.cause == LENGTH else found.size
            elif kind is Bad:
                # Inside a bad frame that has been returned, all is one and the same damage.
                if found.cause != FRAMING and self._offset + at >= self._sorted:
                    self._add_bad(at, found)
                at += 1
            else:
                need = found.size
                break
        if self._sorted < self._offset + at:
            self._add_noise(at)
        self._offset += at
        self._need = need
        self.buffer = buffer[at:]
        self._xors = self._xors[at:]
        reads = self._reads
        while reads and reads[0][0] <= self._offset:
            reads.popleft()
        return frames

    def _add(self, start: int, found: Good) -> None:
        """A valid frame begins at `start`."""
        if self._noise or self._sorted < self._offset + start:
            self._end_noise(start)
        end = start + found.size
        if found.cause:
            self.errors[found.cause] += 1
        elif found.message is None:
            self.errors[UNKNOWN] += 1
        self._frames.append(frame_of((
            self.buffer[start:end], found.type, found.command, found.data, found.message,
            self._stamp_of(end), found.cause, found.error)))
        self._sorted = self._offset + end

    def _add_bad(self, start: int, bad: Bad) -> None:
        """A whole frame begins at `start`, but it is bad."""
        self._end_noise(start)
        end = start + bad.size
        self.errors[bad.cause] += 1
        self._frames.append(bad_frame(self.buffer[start:end], bad.cause, bad.error,
                                      self._stamp_of(end)))
        self._sorted = self._offset + end

    def _add_noise(self, end: int) -> None:
        """What stands before `end`, and in no frame, is noise."""
        first = self._sorted - self._offset
        if first >= end:
            return
        self._noise += self.buffer[first:end]
        self._noise_stamp = self._stamp_of(end)
        self._sorted = self._offset + end
        if len(self._noise) >= MAX_REPORTED:
            whole = len(self._noise) // MAX_REPORTED * MAX_REPORTED
            for at in range(0, whole, MAX_REPORTED):
                self._show_noise(self._noise[at:at + MAX_REPORTED])
            self._noise = self._noise[whole:]

    def _end_noise(self, end: int) -> None:
        """Noise ends before `end`, or before the buffer."""
        self._add_noise(end)
        if self._noise:
            self._show_noise(self._noise)
            self._noise = b''

    def _show_noise(self, noise: bytes) -> None:
        self.errors[FRAMING] += 1
        size = len(noise)
        self._frames.append(bad_frame(
            noise, FRAMING, f'{size} bytes that are no frame' if size > 1
            else '1 byte that is no frame', self._noise_stamp))

    def _stamp_of(self, end: int) -> Any:
        """The stamp of the read that brought the last byte before `end`."""
        reads, end = self._reads, self._offset + end
        if reads[0][0] >= end:
            return reads[0][1]
        # No read is dropped here: a frame that begins inside a false one may end in an earlier one.
        return reads[bisect_left(reads, (end,))][1]
