"""Which bytes of a frame are what: the answer that explains a frame to a person.

Every decoder has ``explain(frame)``, which gives the parts of one frame as it knows them, be the
frame good, bad, incomplete or noise.
"""
from typing import Any, Callable, List, Mapping, NamedTuple, Optional


class Part(NamedTuple):
    """A named stretch of a frame's bytes.

    The parts of a frame stand in order, without gaps, and together are all of its bytes. What is
    missing is a part without bytes, or with too few, that has an error.
    """

    start: int             # its bytes are frame[start:end]
    end: int
    name: str              # in the protocol's words, or the name of a value
    data: bytes            # those bytes; decoded where the wire has them encoded
    raw: Any = None        # the number or text in them; None where they are just bytes
    value: Any = None      # what that stands for, in `unit`: scaled, turned, restored
    unit: str = ''
    meaning: str = ''      # in words, where there is more to say
    error: str = ''        # what is wrong with it, '' where nothing is
    missing: int = 0       # so many of its bytes are missing; then `error` says so
    kind: Optional[str] = None     # what it makes the frame, in words; '': that is not known

    def cut_short(self, missing: int) -> 'Part':
        """The same part, of which so many bytes are missing."""
        return self._replace(missing=missing,
                             error=f'missing, {missing} byte{"s" * (missing > 1)}')

    def moved(self, by: int) -> 'Part':
        """The same part `by` bytes further on."""
        return self._replace(start=self.start + by, end=self.end + by)


class Parts:
    """Cuts a frame into its parts, from the first byte to the last.

    Args:
        frame: the bytes, as many as there are.
    """

    def __init__(self, frame: bytes) -> None:
        self.found: List[Part] = []
        self.at = 0             # what stands before it is in `found`
        self._frame = frame

    @property
    def left(self) -> int:
        """Bytes that are in no part yet."""
        return len(self._frame) - self.at

    def take(self, size: int, name: str, meaning: str = '', error: str = '') -> int:
        """The next `size` bytes are one number, little-endian: return it.

        Where some are missing, the part says so; what is missing counts as 0.
        """
        number = int.from_bytes(self._frame[self.at:self.at + size], 'little')
        self.take_bytes(size, name, meaning, error, number)
        return number

    def take_bytes(self, size: int, name: str, meaning: str = '', error: str = '',
                   number: Any = None) -> None:
        """The next `size` bytes are one part; where some are missing, it says so."""
        data = self._frame[self.at:self.at + size]
        part = Part(self.at, self.at + len(data), name, data, number, number, '', meaning, error)
        if len(data) < size:
            part = part._replace(raw=None, value=None).cut_short(size - len(data))
        self.add(part)

    def take_kind(self, name: str, kinds: Mapping[int, str], must_be: bool = False) -> int:
        """The next byte says of which kind the frame is: return it. It is an error to be none of
        these where it `must_be` one."""
        kind = kinds.get(self._frame[self.at], '') if self.left else None
        unknown = 'not known here' if kind == '' else ''
        number = self.take(1, name, kind or '', unknown) if must_be else \
            self.take(1, name, kind or unknown)
        self.found[-1] = self.found[-1]._replace(kind=kind)
        return number

    def take_data(self, size: int, parts_of: Callable[[bytes], List[Part]]) -> None:
        """The next `size` bytes, or as many as there are, have parts of their own."""
        begin, data = self.at, self._frame[self.at:self.at + size]
        parts = parts_of(data)
        for part in parts:
            self.add(part.moved(begin))
        if len(data) < size and not any(part.error for part in parts):
            self.take_bytes(size - len(data), 'data')

    def take_checksum(self, name: str, checked: bytes) -> None:
        """The next byte is the XOR of `checked`, or should be."""
        is_known = not any(part.missing for part in self.found)
        should_be = 0
        for byte in checked:
            should_be ^= byte
        told = f'should be 0x{should_be:02x}'
        if not is_known or not self.left:
            self.take(1, name, told if is_known else '')
        elif self._frame[self.at] == should_be:
            self.take(1, name, 'matches')
        else:
            self.take(1, name, error=told)

    def take_rest(self, name: str, error: str) -> List[Part]:
        """All bytes that are left are one part, which should not be there; return all parts."""
        if self.left:
            self.take_bytes(self.left, name, error=error)
        return self.found

    def add(self, part: Part) -> None:
        """A part that is known already."""
        self.found.append(part)
        self.at = part.end
