"""When an incomplete frame is given up. All times are seconds of one monotonic clock."""
from collections import deque
from typing import Deque, List, Optional, Tuple

from .stream import Decoder, Frame


class FrameTimer:
    """Watches one decoder, of a link or of a simulated board.

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

    def reset(self) -> None:
        """Begin again, as after a reconnect."""
        self._reads.clear()

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
