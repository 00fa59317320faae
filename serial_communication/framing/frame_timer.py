"""When an incomplete frame is given up. All times are seconds of one monotonic clock."""
from typing import List, Optional

from .stream import Decoder, Frame


class FrameTimer:
    """Watches one decoder, of a link or of a simulated board.

    After `timeout` without a byte an incomplete frame is given up, and noise ends. A frame with a
    false length could still delay valid frames for as long as bytes keep arriving. So a frame that
    takes `timeout` longer than its bytes need on the wire is given up, too, if a valid frame
    begins inside it.

    Args:
        decoder: whose pending frame is watched.
        timeout: s without a byte.
        baud: of the line.
    """

    def __init__(self, decoder: Decoder, timeout: float, baud: int = 115200) -> None:
        self._decoder = decoder
        self._timeout = timeout
        self._seconds_a_byte = 10.0 / baud
        self._front: Optional[int] = None  # where in the stream the pending frame begins
        self._front_at = 0.0               # when it was first seen there

    def reset(self) -> None:
        """Begin again, as after a reconnect."""
        self._front = None

    def due(self, last_byte: float, now: float) -> Optional[float]:
        """When to call `overdue` at the latest; None while nothing is pending.

        Args:
            last_byte: when the latest byte was received.
        """
        if not self._decoder.pending:
            return None
        return min(last_byte + self._timeout, self._overlong_at(now))

    def overdue(self, last_byte: float, now: float) -> List[Frame]:
        """Give up a frame that has waited too long; return the frames, valid and invalid, that
        this completes."""
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
