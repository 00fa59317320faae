"""When a frame that stays incomplete is given up. Times come from the caller's one clock."""
from typing import List, Optional

from .stream import Decoder, Frame


class FrameTimer:
    """Watches one decoder; serves both ends of a line.

    A frame is given up, and noise has ended, when no byte has come for `timeout`. Where bytes keep
    coming, but the frame has taken `timeout` longer than its bytes do on the wire, it is given up
    if a valid one waits behind its start: a false length must not delay valid frames for as long
    as others follow them.

    Args:
        decoder: whose pending frame is watched.
        timeout: s without a byte.
        baud: of the line.
    """

    def __init__(self, decoder: Decoder, timeout: float, baud: int = 115200) -> None:
        self._decoder = decoder
        self._timeout = timeout
        self._seconds_a_byte = 10.0 / baud
        self._front: Optional[int] = None  # where the frame begins that is pending …
        self._front_at = 0.0               # … and since when it does

    def reset(self) -> None:
        """The line is another one."""
        self._front = None

    def due(self, last_byte: float, now: float) -> Optional[float]:
        """When to ask `overdue` at the latest; None while nothing is pending."""
        if not self._decoder.pending:
            return None
        return min(last_byte + self._timeout, self._overlong_at(now))

    def overdue(self, last_byte: float, now: float) -> List[Frame]:
        """What turns up, good and bad, when what has waited too long is given up."""
        decoder = self._decoder
        frames: List[Frame] = []
        if now >= last_byte + self._timeout:
            while decoder.pending:
                frames += decoder.give_up()
        elif decoder.pending and now >= self._overlong_at(now):
            self._front = None
            frames = decoder.skip_false_start()
        return frames

    def _overlong_at(self, now: float) -> float:
        front = self._decoder.front
        if front != self._front:
            self._front, self._front_at = front, now
        return self._front_at + self._timeout + self._decoder.needed * self._seconds_a_byte
