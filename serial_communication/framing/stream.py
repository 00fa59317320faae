"""Finds checksummed frames in a stream of bytes, in time that is linear in the bytes.

Bytes that are not decided yet wait in one buffer. For each of them the XOR of all bytes received
before it is kept, so the XOR of any slice takes one operation, however many false starts are in it.

A *false start* is a byte with which a frame may begin, but none does. After a failed check the
search goes on at the next byte, not behind the false frame, so a valid frame inside it is found.
Such a frame keeps the stamp of the read that had its last byte.

Bytes in no frame are noise, which is returned when it ends.
"""
import re
import struct
from bisect import bisect_left
from collections import deque
from functools import partial
from typing import (Any, Callable, Deque, Dict, FrozenSet, Iterable, List, NamedTuple, Optional,
                    Tuple, Union)

CHECKSUM = 'checksum'        # a whole frame whose checksum does not match
FRAMING = 'framing'          # bytes in no frame: noise, a false length, an incomplete frame
LENGTH = 'length'            # a known type with a wrong length
UNKNOWN = 'unknown type'     # a whole frame of an unknown type
IMPLAUSIBLE = 'implausible'  # a valid frame with impossible values
OVERSIZE = 'oversize'        # a packet longer than the longest valid one

SETTING = 253        # the type of settings, for which the first byte of the data decides, too
MAX_REPORTED = 1100  # bytes; longest `raw` of an invalid frame; no valid frame is as long


class Frame(NamedTuple):
    """A frame or packet as it crossed the wire, or an invalid one, or noise."""

    raw: bytes          # as on the wire
    type: int           # CMD1, message type or TYPE
    number: int         # CMD2 of a request, SEQ of an mcu frame, else 0
    data: bytes         # the payload, decoded
    message: Any        # the typed message; None: the frame is invalid
    stamp: Any = None   # the stamp that `feed` got with the frame's last byte
    cause: str = ''     # one of the causes above; empty: the frame is valid
    error: str = ''     # the cause in words
    ticks: Optional[int] = None    # the board's time of measurement, µs modulo 2 ** 32
    behind: int = 0     # bytes of the same read behind its end

    @property
    def text(self) -> str:
        """Its meaning in one line, for people."""
        return f'{len(self.raw)} invalid bytes' if self.cause else str(self.message)

    @property
    def trouble(self) -> str:
        """The cause and the error; empty for a valid frame."""
        return f'{self.cause}: {self.error}' if self.cause else ''


# Makes a `Frame` of a tuple with all its fields, in half the time that calling the class takes.
frame_of: Callable[[Tuple], Frame] = partial(
    tuple.__new__, Frame)    # type: ignore[assignment]  # mypy does not see that it is a Frame


def stamped(frame: Frame, stamp: Any) -> Frame:
    """The frame with another stamp; in half the time of `_replace`."""
    return frame_of((*frame[:5], stamp, *frame[6:]))


def invalid_frame(raw: bytes, cause: str, error: str, stamp: Any = None) -> Frame:
    """A `Frame` for bytes that are no whole frame, with the first `MAX_REPORTED` of them."""
    return frame_of((raw[:MAX_REPORTED], 0, 0, b'', None, stamp, cause, error, None, 0))


def by_type(*kinds: Any) -> Dict[Any, Any]:
    """Message classes by their types, those of settings by their numbers."""
    return {kind.NUMBER or kind.TYPE: kind for kind in kinds}


class Decoder:
    """Base of all decoders.

    The frames do not depend on how the bytes were cut into reads. No method raises for any bytes,
    and no buffer grows without bound. Every error is returned once, as a frame with a cause.

    Args:
        messages: classes of custom messages: see `layout.message_class`.
    """

    MESSAGES: Dict[Any, Any] = {}            # classes of built-in messages: see `by_type`
    CAUSES: Tuple[str, ...] = (FRAMING,)     # of the errors that it may find
    needed = 1     # bytes that the incomplete frame has, as far as is known

    def __init__(self, messages: Iterable[Any] = ()) -> None:
        self.messages = {**self.MESSAGES, **by_type(*messages)}
        self.unchecked: FrozenSet[int] = frozenset()     # types whose values may be anything
        self.received = 0          # bytes, so far
        self.front = 0             # of them before the incomplete frame; all if there is none
        self._begin()

    def _begin(self) -> None:
        """Nothing was received, or what was is dropped."""

    @property
    def begun(self) -> bool:
        """Whether a frame has begun that is not complete."""
        return self.front < self.received

    @property
    def pending(self) -> bool:
        """Whether bytes wait that are in no returned frame."""
        return self.begun

    def add_message(self, kind: Any) -> None:
        """Decode custom messages of this class from now on; from any thread."""
        self.messages = {**self.messages, **by_type(kind)}

    def remove_message(self, kind: Any) -> None:
        """Decode them no longer; from any thread."""
        self.messages = {key: each for key, each in self.messages.items() if each is not kind}

    def whole(self, raw: bytes, type_: int, number: int, data: bytes, ticks: Optional[int] = None,
              stamp: Any = None, behind: int = 0) -> Frame:
        """A whole frame with its message, or with the cause for which that is refused."""
        kind = self.messages.get(type_)
        if type_ == SETTING:
            kind = self.messages.get(data[:1], kind)
        if kind is None:
            cause, error = UNKNOWN, f'type {type_} is unknown'
        else:
            try:
                message = kind.unpack(data)
                why = type_ not in self.unchecked and message.implausible()
                if not why:
                    if kind.TICKS_AT is not None:
                        ticks = message[kind.TICKS_AT]
                    return frame_of(
                        (raw, type_, number, data, message, stamp, '', '', ticks, behind))
                cause, error = IMPLAUSIBLE, f'{kind.LABEL}: {why}'
            except struct.error:
                cause, error = LENGTH, (f'{kind.LABEL} with {len(data)} bytes of data where '
                                        f'{kind.LAYOUT.sizes()} is right')
        return Frame(raw, type_, number, data, None, stamp, cause, error, None, behind)

    def feed(self, data: bytes, stamp: Any = None) -> List[Frame]:
        """Decode the bytes of one read; return the frames, valid and invalid, now complete."""
        raise NotImplementedError

    def give_up(self) -> List[Frame]:
        """No byte has been received for too long: give up the incomplete frame, and end noise.

        To be called until nothing is `pending`.
        """
        raise NotImplementedError

    def reset(self) -> None:
        """Drop what is pending, as after a reconnect; the counts stay."""
        self.front = self.received
        self._begin()


def running_xor(data: bytes, before: int) -> bytes:
    """For each byte of `data`, the XOR of `before` and all bytes up to and including it.

    Shifts of one long integer, each twice as far as the one before, take log2(n) steps.
    """
    size = len(data)
    bits, shift = size * 8, 8
    value = int.from_bytes(data, 'big') ^ before << bits >> 8
    while shift < bits:
        value ^= value >> shift
        shift *= 2
    return value.to_bytes(size, 'big')


class FrameTimer:
    """Says when the incomplete frame of a decoder is given up. All times are s of one clock.

    After `timeout` without a byte an incomplete frame is given up, and noise ends. Whatever is
    received meanwhile, a frame is also given up `timeout` and its own time on the wire after its
    first byte. So a false length cannot delay other frames, or hold a link, for longer.

    Args:
        decoder: whose pending frame is watched.
        timeout: s without a byte.
        baud: of the line.
    """

    def __init__(self, decoder: Decoder, timeout: float, baud: int = 115200) -> None:
        self._decoder = decoder
        self._timeout = timeout
        self._seconds_a_byte = 10.0 / baud
        # Of each read with bytes of the incomplete frame: the bytes received by then, and its time.
        self._reads: Deque[Tuple[int, float]] = deque()

    def due(self, last_byte: float) -> Optional[float]:
        """When to call `overdue` at the latest; None while nothing is pending.

        To be called after each read, or `overdue`.

        Args:
            last_byte: when the latest byte was received.
        """
        decoder, reads = self._decoder, self._reads
        if not decoder.pending:
            reads.clear()
            return None
        if not reads or reads[-1][0] != decoder.received:
            reads.append((decoder.received, last_byte))
        while reads and reads[0][0] <= decoder.front:
            reads.popleft()
        begun = reads[0][1] + decoder.needed * self._seconds_a_byte if reads else last_byte
        return min(last_byte, begun) + self._timeout

    def overdue(self, last_byte: float, now: float) -> List[Frame]:
        """Give up what has waited too long; return the frames, valid and invalid, that this
        completes."""
        frames: List[Frame] = []
        due = self.due(last_byte)
        while due is not None and now >= due:
            frames += self._decoder.give_up()
            due = self.due(last_byte)
        return frames


class StreamDecoder(Decoder):
    """Base of decoders for frames with a checksum: it buffers and resynchronises.

    A subclass gives the bytes with which a frame may begin (`STARTS`), and says what begins at
    such a byte (`frame_at`, which reads `buffer` and computes checksums by `xor`).

    Each error is returned as one invalid frame, in whatever pieces its bytes were read. It is a
    whole frame, or noise. Noise ends where a frame begins, after a silence (`give_up`) or after
    `MAX_REPORTED` bytes.
    """

    CAUSES: Tuple[str, ...] = (CHECKSUM, FRAMING)
    STARTS = b''

    def __init__(self, messages: Iterable[Any] = ()) -> None:
        super().__init__(messages)
        self._any_start = re.compile(b'[' + re.escape(self.STARTS) + b']')

    def _begin(self) -> None:
        self.buffer = b''          # bytes that are not decided yet
        self.needed = 1            # bytes in the buffer before the search can go on
        self._xors = b'\0'         # for each of them, and the next: XOR of all bytes before it
        self._stamp: Any = None    # of the latest read
        # Of each earlier read with bytes in the buffer: the bytes received by then, and its stamp.
        self._reads: Deque[Tuple[int, Any]] = deque()
        self._frames: List[Frame] = []
        self._noise = b''          # noise that has not ended yet
        self._noise_stamp: Any = None    # of its last byte
        self._classified = self.front    # bytes of the stream before this are in a frame or noise

    @property
    def pending(self) -> bool:
        return bool(self.buffer or self._noise)

    def feed(self, data: bytes, stamp: Any = None) -> List[Frame]:
        if not data:
            return []
        if self.buffer:
            self._reads.append((self.received, self._stamp))
        self._stamp = stamp
        self.received += len(data)
        self.buffer += data
        self._xors += running_xor(data, self._xors[-1])
        return [] if len(self.buffer) < self.needed else self._search(0)

    def give_up(self) -> List[Frame]:
        # The search goes on at the second byte.
        frames = self._search(1 if self.buffer else 0)
        if not self.buffer:
            self._add_noise(0, True)
        return frames

    # -- for subclasses ---------------------------------------------------------------

    def frame_at(self, at: int) -> Union[Frame, int, None]:
        """What begins at this index of the buffer, where one of `STARTS` is: a whole frame, valid
        or not, without stamp; None: no frame; or, if one may begin there, how many bytes from there
        on are needed to decide more."""
        raise NotImplementedError

    def xor(self, start: int, end: int) -> int:
        """The XOR of buffer[start:end], in constant time."""
        return self._xors[start] ^ self._xors[end]

    # -- the search -------------------------------------------------------------------

    def _search(self, at: int) -> List[Frame]:
        """Decide as many bytes as possible, from buffer[at] on; before it no frame begins."""
        frames: List[Frame] = []
        self._frames = frames
        buffer, size = self.buffer, len(self.buffer)
        need = 1
        while at < size:
            if buffer[at] not in self.STARTS:
                start = self._any_start.search(buffer, at)
                at = start.start() if start else size
                continue
            found = self.frame_at(at)
            if found is None:
                at += 1
            elif isinstance(found, int):
                need = found
                break
            else:
                # An invalid frame inside another one that was returned is the same error.
                if found.cause != CHECKSUM or self.front + at >= self._classified:
                    self._add(at, found)
                # The length may be false, too: two equal frames inside do not change an XOR.
                at += 1 if found.cause in (CHECKSUM, LENGTH) else len(found.raw)
        if self._classified < self.front + at:
            self._add_noise(at, False)
        self.front += at
        self.needed = need
        self.buffer = buffer[at:]
        self._xors = self._xors[at:]
        reads = self._reads
        while reads and reads[0][0] <= self.front:
            reads.popleft()
        return frames

    def _add(self, start: int, frame: Frame) -> None:
        """Add the frame that begins at `start`."""
        if self._noise or self._classified < self.front + start:
            self._add_noise(start, True)
        raw, type_, number, data, message, _, cause, error, ticks, _ = frame
        end = start + len(raw)
        stamp, read_end = self._read_of(end)
        self._classified = self.front + end
        self._frames.append(frame_of((raw, type_, number, data, message, stamp, cause, error, ticks,
                                      read_end - self._classified)))

    def _add_noise(self, end: int, is_over: bool) -> None:
        """Add the bytes before `end` that are in no frame to the noise, which is perhaps over."""
        first = self._classified - self.front
        if first < end:
            self._noise += self.buffer[first:end]
            self._noise_stamp = self._read_of(end)[0]
            self._classified = self.front + end
        while len(self._noise) >= MAX_REPORTED or is_over and self._noise:
            noise, self._noise = self._noise[:MAX_REPORTED], self._noise[MAX_REPORTED:]
            self._frames.append(invalid_frame(
                noise, FRAMING, f'{len(noise)} byte{"s" * (len(noise) > 1)} outside frames',
                self._noise_stamp))

    def _read_of(self, end: int) -> Tuple[Any, int]:
        """The read that had the last byte before `end`: its stamp, and the bytes received by
        then."""
        reads, end = self._reads, self.front + end
        if not reads or reads[-1][0] < end:
            return self._stamp, self.received
        # No read is dropped here: a later frame, inside a false one, may end in an earlier read.
        received, stamp = reads[bisect_left(reads, (end,))]
        return stamp, received
