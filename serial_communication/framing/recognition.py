"""Finds out whose frames a stream of bytes has.

The decoders of all boards read the same bytes. Bytes of another board, of another baud rate or of
noise are sometimes a valid frame by chance, above all without a checksum. So a board is recognised
only by several valid frames that have most of the bytes.
"""
from typing import Callable, List, Mapping

from .stream import UNKNOWN, Decoder, Frame

_FRAMES = 3        # the fewest valid frames
_WINDOW = 4096     # bytes; then the decision is made anew


class Recognition:
    """Reads a stream until its board is known, and goes on, since another one may follow.

    Args:
        decoders: by the boards' names; each makes a decoder of what the board sends.
    """

    def __init__(self, decoders: Mapping[str, Callable[[], Decoder]]) -> None:
        self.name = ''          # of the board; '': not recognised
        self._candidates = [_Candidate(name, make()) for name, make in decoders.items()]
        self._size = 0

    def feed(self, data: bytes) -> None:
        """Read some more bytes."""
        for each in self._candidates:
            each.count(each.decoder.feed(data))
        self._size += len(data)
        self._decide(self._size >= _WINDOW)
        if self._size >= _WINDOW:
            self._begin()

    def reset(self) -> None:
        """Begin anew, as with another stream."""
        self.name = ''
        self._begin()

    def finish(self) -> None:
        """There are no more bytes: also count what waits for more."""
        for each in self._candidates:
            while each.decoder.pending:
                each.count(each.decoder.give_up())
        self._decide(False)

    def _begin(self) -> None:
        for each in self._candidates:
            each.reset()
        self._size = 0

    def _decide(self, is_final: bool) -> None:
        found = max(self._candidates, key=lambda each: each.valid, default=None)
        if found and found.frames >= _FRAMES and found.valid > found.invalid:
            self.name = found.name
        elif is_final:
            self.name = ''


class _Candidate:
    """What one board's decoder made of the bytes."""

    def __init__(self, name: str, decoder: Decoder) -> None:
        self.name = name
        self.decoder = decoder
        self.reset()

    def reset(self) -> None:
        self.decoder.reset()
        self.valid = 0        # bytes in valid frames
        self.frames = 0       # these frames
        self.invalid = 0      # other bytes

    def count(self, frames: List[Frame]) -> None:
        for frame in frames:
            if frame.message is not None:
                self.valid += len(frame.raw)
                self.frames += 1
            elif frame.cause not in ('', UNKNOWN):
                self.invalid += len(frame.raw)
