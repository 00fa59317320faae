"""Finding checksummed frames in a byte stream, at a cost that is linear in the bytes.

Strategy: all bytes not yet decided stand in one buffer, and beside each of them the XOR of
every byte received so far. The XOR of any stretch is then that of two numbers, however long
the stretch is and however many false starts lie in it. A failed check moves the search on by
one byte, not past the false frame, so a good frame that begins inside is found. A frame that
had to wait behind a false start keeps the stamp of the read that brought its last byte.
"""
import copy
from collections import deque
from typing import Any, Dict, List, NamedTuple

CHECKSUM = 'checksum'        # a whole frame whose checksum does not match
FRAMING = 'framing'          # bytes that are no frame: noise, a false length, a frame cut short
LENGTH = 'length'            # a known type with a length that is not its own
UNKNOWN = 'unknown type'     # a sound frame of a type nobody told us of
IMPLAUSIBLE = 'implausible'  # a sound packet whose values cannot be
OVERSIZE = 'oversize'        # a packet longer than any packet may be

_new = tuple.__new__

MAX_REPORTED = 1100  # more than any frame has; bytes of noise that one bad frame quotes at most


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


def good_frame(raw: bytes, type_: int, command: int, data: bytes, message: Any,
               stamp: Any) -> Frame:
    """A `Frame` without a cause; in half the time of the constructor, which this often matters."""
    return _new(Frame, (raw, type_, command, data, message, stamp, '', ''))


def bad_frame(raw: bytes, cause: str, error: str, stamp: Any = None, type_: int = 0,
              data: bytes = b'') -> Frame:
    """A `Frame` that says what was wrong with `raw`."""
    return Frame(bytes(raw[:MAX_REPORTED]), type_, 0, data, None, stamp, cause, error)


def running_xor(data: bytes, before: int) -> bytes:
    """For each byte of `data`, the XOR of `before` and every byte up to and including it.

    Doubling shifts of one long integer take log2(n) steps instead of n.
    """
    size = len(data)
    value = int.from_bytes(data, 'little') ^ before
    bits, shift = size * 8, 8
    while shift < bits:
        value ^= value << shift
        shift *= 2
    return (value & ((1 << bits) - 1)).to_bytes(size, 'little')


def _has_good(frames: List[Frame]) -> bool:
    return any(not frame.cause for frame in frames)


class StreamDecoder:
    """The buffer, the counting and the resynchronising that checksummed framings share.

    A subclass supplies `_search`: it looks for frames from an index on, calls `_good`,
    `_failed` and `_noise` for what it meets, and ends with `_keep`.
    """

    def __init__(self) -> None:
        self.errors: Dict[str, int] = {CHECKSUM: 0, FRAMING: 0}
        # Nothing pending, which is the rule: the very bytes that were read. Else a bytearray.
        self._buffer = b''
        self._xor = b''             # beside each byte: XOR of all bytes received up to it
        self._before = 0            # the same for the byte before the buffer's first
        self._need = 1              # bytes in the buffer before searching on makes sense
        self._offset = 0            # bytes received before the buffer's first
        self._stamp = None          # of the latest read
        self._arrivals = deque()    # (bytes received in all, stamp) of each read still pending
        self._blamed = 0            # up to this byte of the stream, damage is counted already
        self._noisy = False         # the last byte looked at is noise that is counted already
        self._frames: List[Frame] = []
        self._reported = 0          # up to this index of the buffer, bytes stand in a frame

    @property
    def pending(self) -> bool:
        """Whether a frame has begun and is not complete."""
        return bool(self._buffer)

    @property
    def front(self) -> int:
        """Where in the stream the frame begins that is pending, in bytes received before it."""
        return self._offset

    @property
    def needed(self) -> int:
        """How many bytes that frame has, as far as is known yet."""
        return self._need

    def feed(self, data: bytes, stamp: Any = None) -> List[Frame]:
        """Take bytes as they were read; return the frames, good and bad, now complete."""
        if not data:
            return []
        self._stamp = stamp
        if not self._buffer:
            self._buffer = data
            self._xor = running_xor(data, self._before)
        else:
            self._xor += running_xor(data, self._xor[-1])
            self._buffer += data
            self._arrivals.append((self._offset + len(self._buffer), stamp))
            if len(self._buffer) < self._need:
                return []
        return self._run(0)

    def give_up(self) -> List[Frame]:
        """The frame at the front stays incomplete: go on at the byte after its first."""
        if not self._buffer:
            return []
        if self._offset >= self._blamed:
            self._failed(0, len(self._buffer), FRAMING, 'cut short')
        return self._run(1)

    def doubt(self) -> List[Frame]:
        """The frame at the front takes long: give it up if a sound one stands behind its start.

        Else a false length would hold sound frames back for as long as others follow them.
        """
        if not self._buffer:
            return []
        other = copy.copy(self)
        other.errors = dict(self.errors)
        other.reset()
        found = other.feed(bytes(self._buffer[1:]))
        while other.pending and not _has_good(found):
            found = other.give_up()
        if not _has_good(found):
            return []
        frames = self.give_up()
        while not _has_good(frames):
            frames += self.give_up()
        return frames

    def reset(self) -> None:
        """Forget what is pending, as after a reconnect; the counts stay."""
        errors = self.errors
        StreamDecoder.__init__(self)
        self.errors = errors

    # -- for subclasses ---------------------------------------------------------------

    def _search(self, at: int) -> None:
        raise NotImplementedError

    def _run(self, at: int) -> List[Frame]:
        self._frames = frames = []
        self._search(at)
        return frames

    def _good(self, start: int, end: int, type_: int, command: int, data: bytes,
              message: Any) -> None:
        """A sound frame stands at buffer[start:end]."""
        if start > self._reported:
            self._report_noise(start)
        stamp = self._stamp
        if self._arrivals:
            stamp = self._arrived(self._offset + end)
        self._frames.append(good_frame(bytes(self._buffer[start:end]), type_, command, data,
                                       message, stamp))
        self._reported = end
        self._blamed = self._offset + end
        self._noisy = False

    def _arrived(self, received: int) -> Any:
        """The stamp of the read that brought that byte."""
        arrivals = self._arrivals
        while arrivals[0][0] < received:
            arrivals.popleft()
        return arrivals[0][1]

    def _failed(self, start: int, end: int, cause: str, error: str) -> None:
        """What began at `start` and would have ended at `end` is no frame.

        To be called once for one damage: not for false starts before `_blamed`.
        """
        self.errors[cause] += 1
        self._blamed = self._offset + end
        self._noisy = False
        if cause == CHECKSUM:
            if start > self._reported:
                self._report_noise(start)
            self._frames.append(bad_frame(self._buffer[start:end], cause, error, self._stamp))
            self._reported = end

    def _noise(self, start: int, end: int) -> None:
        """buffer[start:end] holds no beginning of a frame. One stretch counts once."""
        if self._offset + end > self._blamed and not self._noisy:
            self.errors[FRAMING] += 1
            self._noisy = True

    def _keep(self, start: int, need: int) -> None:
        """The search ended: all before `start` is decided; go on at `need` bytes from there."""
        if start > self._reported:
            self._report_noise(start)
        if start:
            self._before = self._xor[start - 1]
            self._offset += start
        size = len(self._buffer) - start
        if not size:
            self._buffer = self._xor = b''
            self._reported = 0
            self._arrivals.clear()
            return
        self._reported = max(self._reported - start, 0)
        self._need = need
        if self._arrivals:
            self._arrived(self._offset + 1)      # forgets the reads that are decided
        else:
            self._arrivals.append((self._offset + size, self._stamp))
        if isinstance(self._buffer, bytearray):
            del self._buffer[:start]
            del self._xor[:start]
        else:
            self._buffer = bytearray(self._buffer[start:])
            self._xor = bytearray(self._xor[start:])

    def _report_noise(self, end: int) -> None:
        size = end - self._reported
        self._frames.append(bad_frame(
            self._buffer[self._reported:end], FRAMING,
            '%d byte%s that %s no frame' % (size, 's' if size > 1 else '',
                                            'are' if size > 1 else 'is'), self._stamp))
        self._reported = end
