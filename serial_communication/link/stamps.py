"""Stamps of the measurement, from the times that a board sends."""
from collections import deque
from typing import Any, Callable, Deque, List, NamedTuple, Tuple

from ..framing.board_time import BoardClock
from ..framing.stream import Frame

_DELAYS = 1000     # the latest, of which `values` are


class Read(NamedTuple):
    """When bytes were read."""

    stamp: Any      # by the clock of the link
    at: float       # monotonic


class Stamps:
    """The stamps of one link's frames.

    Args:
        seconds_a_byte: on the wire; 0.0: not known, as in a network.
        earlier: returns the stamp so many seconds before a stamp.
    """

    def __init__(self, seconds_a_byte: float, earlier: Callable[[Any, float], Any]) -> None:
        self.clock = BoardClock()
        self._seconds_a_byte = seconds_a_byte
        self._earlier = earlier
        self._is_told = False                # the board has sent a time
        self._delays: Deque[float] = deque(maxlen=_DELAYS)     # s from measurement to read

    def reset(self) -> None:
        """The port was opened, or the bridge stalled."""
        self.clock.reset()
        self._delays.clear()

    def of(self, frame: Frame, read: Read) -> Any:
        """The stamp of a frame: that of its measurement if it is known, else that of its read."""
        if frame.ticks is None:
            return read.stamp
        self._is_told = True
        measured = self.clock.measured_at(
            frame.ticks, read.at - frame.behind * self._seconds_a_byte)
        if measured is None:
            return read.stamp
        self._delays.append(read.at - measured)
        return self._earlier(read.stamp, read.at - measured)

    def values(self) -> List[Tuple[str, Any]]:
        """For /diagnostics; empty if the board sends no time. From any thread."""
        if not self._is_told:
            return []
        delays = sorted(self._delays)
        known = [f'{self.clock.drift:.0f}', f'{delays[len(delays) // 2] * 1e3:.2f}',
                 f'{delays[-1] * 1e3:.2f}'] if delays else ['unknown'] * 3
        return [*zip(('board clock [ppm]', 'read delay p50 [ms]', 'read delay max [ms]'), known),
                ('clock errors', self.clock.errors)]
