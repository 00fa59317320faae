"""Finds out what a link receives instead of messages of its board."""
import re
from typing import Callable, Iterable, NamedTuple, Set

from ..framing.layout import readable
from ..framing.recognition import Recognition
from ..framing.stream import FRAMING, OVERSIZE, UNKNOWN, Decoder, Frame

_ENOUGH = 32      # bytes; fewer may be noise on a line without a board
_FRAMES = 3       # of unknown types; fewer may be noise on a line without checksums
_PAUSE = 3.0      # s without a byte after which the bytes before no longer count
_MOST_TYPES = 5   # that are named
# What Serial.println and printf send, at the beginning of an invalid frame; long enough that noise
# hardly ever looks like it.
_CHARACTER = rb'(?:[\t -~]|[\xc2-\xf4][\x80-\xbf]{1,3})'
_TEXT = re.compile(b'C+\r\n|C{8,}\n|C{24,}'.replace(b'C', _CHARACTER))


class OtherBoard(NamedTuple):
    """A board whose frames a link recognises, to say that it is connected to the wrong port."""

    name: str
    decoder: Callable[[], Decoder]    # makes a decoder of what the board sends
    has_port: bool                    # whether it has a link in this bridge, too


class UnknownBytes:
    """Counts the bytes since the last frame, and tries the decoders of other boards on them.

    Recognises text, also between frames, and frames of types that nobody knows. `print_to` is what
    a sketch should print to instead of the port.
    """

    def __init__(self, others: Iterable[OtherBoard], baud: int = 115200,
                 print_to: str = 'another port') -> None:
        self._others = {other.name: other for other in others}
        self._recognition = Recognition(
            {name: other.decoder for name, other in self._others.items()})
        self._baud, self._print_to = baud, print_to
        self.understood_at = float('-inf')   # the latest frame of a known type; monotonic
        self.opened()

    def opened(self) -> None:
        self._may_be_cut = True     # the next invalid frame may have begun before
        self._printed_at = float('-inf')     # when the latest text was received; monotonic
        self.reset()

    def reset(self) -> None:
        """A frame was received, or there was a pause: begin anew."""
        self.size = 0          # bytes
        self._last_at = 0.0    # when the latest of them was received; monotonic
        self._types: Set[int] = set()    # unknown types of frames
        self._frames = 0                 # of unknown types
        self._surplus = 0                # bytes of these frames, less those of invalid ones
        self._recognition.reset()

    def add(self, frame: Frame, now: float) -> str:
        """Count a frame without a message; if it is printed text, return a line that says so."""
        if frame.cause in ('', UNKNOWN):
            self._types.add(frame.type)
            self._frames += 1
            self._surplus += len(frame.raw)
            return ''
        self._surplus -= len(frame.raw)
        text = frame.cause in (FRAMING, OVERSIZE) and not self._may_be_cut \
            and _TEXT.match(frame.raw)
        self._may_be_cut = False
        if not text:
            return ''
        self._printed_at = now
        return f'{self.printed(now)}: {readable(text.group()[:60].decode("utf-8", "replace"))!r}'

    def printed(self, now: float) -> str:
        """That the board prints text, for people; '' if it does not now."""
        return f'the sketch prints text to this port: use {self._print_to}' \
            if now <= self._printed_at + _PAUSE else ''

    def feed(self, data: bytes, now: float) -> None:
        """Count the bytes of one read that had no frame."""
        if now > self._last_at + _PAUSE:
            self.reset()
        self.size += len(data)
        self._last_at = now
        self._recognition.feed(data)

    def meaning(self, now: float) -> str:
        """What they are, for people; '' if too few bytes are received now."""
        if now > self._last_at + _PAUSE:
            return ''
        other = self._others.get(self._recognition.name)
        if other:
            return f"bytes come, but they are the {other.name}'s: " + (
                'are the two ports swapped?' if other.has_port else 'is this its port?')
        if self._frames >= _FRAMES and self._surplus > 0 and not self.printed(now):
            types = ', '.join(map(str, sorted(self._types)[:_MOST_TYPES]))
            return (f'messages come, but of unknown types ({types}): no row of the parameters, '
                    'and none that the board announces, has them')
        return self.printed(now) or ('' if self.size < _ENOUGH else (
            f'bytes come, but no valid frame of this board: another baud rate ({self._baud} '
            'is set), or another board'))
