"""Stamps of the measurement, from the times that a board sends."""
from collections import deque
from typing import Any, Callable, Deque, List, NamedTuple, Optional, Tuple

from ..framing.board_time import MOST_DELAY, BoardClock
from ..framing.stream import Frame
from .sparing_log import SparingLog

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
        log: gets the frames that are too old.
        is_on: False: the stamps are those of the reads.
    """

    def __init__(self, seconds_a_byte: float, earlier: Callable[[Any, float], Any],
                 log: SparingLog, is_on: bool) -> None:
        self._clock = BoardClock()
        self._seconds_a_byte = seconds_a_byte
        self._earlier = earlier
        self._log = log
        self._is_on = is_on
        self._is_told = False                # the board has sent a time
        self._delays: Deque[float] = deque(maxlen=_DELAYS)     # s from measurement to read
        self._latest: Optional[Tuple[int, float]] = None     # time of the board, and ours

    def reset(self) -> None:
        """The port was opened, or the bridge stalled."""
        self._clock.reset()
        self._delays.clear()
        self._latest = None

    def measured(self, frame: Frame, read: Read) -> Frame:
        """The frame with the stamp of its measurement; as it is if that is not known."""
        if frame.ticks is None or not self._is_on:
            return frame
        at = self._measured_at(frame.ticks, read.at, frame.behind)
        if at is None:
            return frame
        self._delays.append(read.at - at)
        return frame._replace(stamp=self._earlier(read.stamp, read.at - at))

    def _measured_at(self, ticks: int, read_at: float, behind: int) -> Optional[float]:
        latest = self._latest
        if latest and latest[0] == ticks and read_at - latest[1] <= MOST_DELAY:
            return latest[1]     # of several frames of one time only the first is a point
        self._is_told, errors = True, self._clock.errors
        at = self._clock.measured_at(ticks, read_at - behind * self._seconds_a_byte)
        if self._clock.errors > errors:
            self._log.warn('clock', "by the board's clock a frame is over 1 s old: it has the "
                           'stamp of its read')
        self._latest = None if at is None else (ticks, at)
        return at

    def values(self) -> List[Tuple[str, Any]]:
        """For /diagnostics; empty if the board sends no time. From any thread."""
        if not self._is_told:
            return []
        delays = sorted(self._delays)
        known = [f'{self._clock.drift:.0f}', f'{delays[len(delays) // 2] * 1e3:.2f}',
                 f'{delays[-1] * 1e3:.2f}'] if delays else ['unknown'] * 3
        return [*zip(('board clock [ppm]', 'read delay p50 [ms]', 'read delay max [ms]'), known),
                ('clock errors', self._clock.errors)]
