"""What each byte of a frame means, for programs that explain frames to people.

``explain(frame)`` of a decoder returns the parts of one frame, valid, invalid, incomplete or noise.
"""
from typing import Any, Callable, List, Mapping, NamedTuple, Optional


class Part(NamedTuple):
    """Adjacent bytes of a frame that have one name.

    The parts of a frame are in order, have no gaps, and together are all of its bytes. Missing
    bytes are a part that has an error and fewer bytes than it should have, or none.
    """

    start: int             # its bytes are frame[start:end]
    end: int
    name: str              # as the protocol has it, or the name of a value
    data: bytes            # those bytes, decoded if the wire has them encoded
    raw: Any = None        # the number or text in them; None: just bytes
    value: Any = None      # that number scaled and converted, in `unit`
    unit: str = ''
    meaning: str = ''      # more about it, in words
    error: str = ''        # what is wrong; '': nothing
    missing: int = 0       # how many of its bytes are missing; `error` says so, too
    kind: Optional[str] = None     # for a type byte: the frame's kind in words; '': unknown

    def cut_short(self, missing: int) -> 'Part':
        return self._replace(missing=missing,
                             error=f'missing, {missing} byte{"s" * (missing > 1)}')


class Parts:
    """Cuts a frame, which may be incomplete, into its parts from the first byte on."""

    def __init__(self, frame: bytes) -> None:
        self.found: List[Part] = []
        self.at = 0             # index of the first byte that is in no part yet
        self._frame = frame

    @property
    def left(self) -> int:
        """Bytes that are in no part yet."""
        return len(self._frame) - self.at

    def take(self, size: int, name: str, meaning: str = '', error: str = '') -> int:
        """Add the next `size` bytes as one little-endian number, and return it.

        Missing bytes are noted in the part and count as 0.
        """
        number = int.from_bytes(self._frame[self.at:self.at + size], 'little')
        self.take_bytes(size, name, meaning, error, number)
        return number

    def take_bytes(self, size: int, name: str, meaning: str = '', error: str = '',
                   number: Any = None) -> None:
        """Add the next `size` bytes as one part; missing bytes are noted in it."""
        data = self._frame[self.at:self.at + size]
        part = Part(self.at, self.at + len(data), name, data, number, number, '', meaning, error)
        if len(data) < size:
            part = part._replace(raw=None, value=None).cut_short(size - len(data))
        self.add(part)

    def take_kind(self, name: str, kinds: Mapping[int, str], must_be: bool = False) -> int:
        """Add the next byte, which gives the frame's kind, and return it.

        Args:
            kinds: in words, by number.
            must_be: whether another number is an error.
        """
        kind = kinds.get(self._frame[self.at], '') if self.left else None
        unknown = 'not known here' if kind == '' else ''
        number = self.take(1, name, kind or '', unknown) if must_be else \
            self.take(1, name, kind or unknown)
        self.found[-1] = self.found[-1]._replace(kind=kind)
        return number

    def take_data(self, size: int, parts_of: Callable[[bytes], List[Part]]) -> None:
        """Add the parts that `parts_of` finds in the next `size` bytes, or in what is left."""
        begin, data = self.at, self._frame[self.at:self.at + size]
        parts = parts_of(data)
        for part in parts:
            self.add(part._replace(start=begin + part.start, end=begin + part.end))
        if len(data) < size and not any(part.error for part in parts):
            self.take_bytes(size - len(data), 'data')

    def take_checksum(self, name: str, checked: bytes) -> None:
        """Add the next byte, which should be the XOR of `checked`."""
        is_known = not any(part.missing for part in self.found)
        should_be = 0
        for byte in checked:
            should_be ^= byte
        expected = f'should be 0x{should_be:02x}'
        if not is_known or not self.left:
            self.take(1, name, expected if is_known else '')
        elif self._frame[self.at] == should_be:
            self.take(1, name, 'matches')
        else:
            self.take(1, name, error=expected)

    def take_padding(self, end: int) -> None:
        """Add the bytes before frame[end] that are in no part yet, if any."""
        size = min(end - self.at, self.left)
        if size > 0:
            self.take_bytes(size, 'padding')

    def take_rest(self, name: str, error: str) -> List[Part]:
        """Add the bytes that are left, if any, as one part with an error; return all parts."""
        if self.left:
            self.take_bytes(self.left, name, error=error)
        return self.found

    def add(self, part: Part) -> None:
        """Add a part as it is."""
        self.found.append(part)
        self.at = part.end
