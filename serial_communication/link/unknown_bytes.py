"""Bytes that a link receives while no frame of its board is among them: what are they?"""
from typing import Callable, Iterable, NamedTuple

from ..framing.recognition import Recognition
from ..framing.stream import Decoder

_ENOUGH = 32      # bytes; fewer may be noise on a line without a board
_PAUSE = 3.0      # s without a byte after which the bytes before no longer count


class OtherBoard(NamedTuple):
    """A board whose frames a link recognises, to say that it is connected to the wrong port."""

    name: str
    decoder: Callable[[], Decoder]    # makes a decoder of what the board sends
    has_port: bool                    # whether it has a link in this bridge, too


class UnknownBytes:
    """Counts the bytes since the last frame, and tries the decoders of other boards on them.

    Args:
        others: boards other than the link's own.
    """

    def __init__(self, others: Iterable[OtherBoard]) -> None:
        self._others = {other.name: other for other in others}
        self.reset()

    def reset(self) -> None:
        """A frame was received, or the port was opened: begin anew."""
        self.size = 0          # bytes
        self._last_at = 0.0    # when the latest of them was received; monotonic
        self._recognition = Recognition({
            other.name: other.decoder for other in self._others.values()})

    def take(self, data: bytes, now: float) -> None:
        """Count the bytes of one read, in which no frame was."""
        if now > self._last_at + _PAUSE:
            self.reset()
        self.size += len(data)
        self._last_at = now
        self._recognition.feed(data)

    def meaning(self, baud: int, now: float) -> str:
        """What they are, for people; '' if too few bytes are received now."""
        if self.size < _ENOUGH or now > self._last_at + _PAUSE:
            return ''
        other = self._others.get(self._recognition.name)
        if other is None:
            return (f'bytes come, but none is a frame of this board: another baud rate ({baud} is '
                    'set), or another board')
        return f"bytes come, but they are the {other.name}'s: " + (
            'are the two ports swapped?' if other.has_port else 'is this its port?')
