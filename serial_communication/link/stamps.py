"""Stamps of the measurement, from the times that a board sends."""
from collections import deque
from typing import Any, Callable, Deque, List, NamedTuple, Optional, Tuple

from ..framing.board_time import MOST_DELAY, BoardClock
from ..framing.stream import Frame
from ..transport.port import Port
from .sparing_log import SparingLog

_DELAYS = 200     # the latest measurements, of which `values` are


class Read(NamedTuple):
    """When bytes were read."""

    stamp: Any      # by the clock of the link
    at: float       # monotonic


class Stamps:
    """The stamps of one link's frames.

    Args:
        earlier: returns the stamp so many seconds before a stamp.
        is_on: False: the stamps are those of the reads.
    """

    def __init__(self, port: Port, earlier: Callable[[Any, float], Any], log: SparingLog,
                 is_on: bool) -> None:
        self._clock = BoardClock()
        self._port = port
        self._earlier = earlier
        self._log = log
        self._is_on = is_on
        self._errors = 0                     # frames that were too old
        self._ticks: Optional[int] = None    # the board's latest time
        self._at: Optional[float] = None     # when that was, monotonic; None: not known
        self._stamp: Any = None              # the same as a stamp
        self._delays: Deque[float] = deque(maxlen=_DELAYS)     # s from measurement to read

    def reset(self) -> None:
        """The port was opened, or the bridge stalled."""
        self._clock.reset()
        self._delays.clear()
        self._ticks = None

    def of(self, frame: Frame, read: Read) -> Any:
        """The stamp of the frame's measurement, the same for all of its frames; that of its read if
        it is not known."""
        if frame.ticks is None or not self._is_on:
            return read.stamp
        if frame.ticks != self._ticks:
            self._ticks = frame.ticks
            wire_time = (len(frame.raw) + frame.behind) * self._port.byte_time
            self._at = self._clock.measured_at(frame.ticks, read.at - wire_time)
            if self._at is not None:
                self._stamp = self._earlier(read.stamp, read.at - self._at)
        if self._at is None:
            return read.stamp
        delay = read.at - self._at
        if delay > MOST_DELAY:
            self._errors += 1
            self._log.warn('clock', "by the board's clock a frame is over 1 s old: it has the "
                           'stamp of its read')
            return read.stamp
        if not self._earlier(read.stamp, MOST_DELAY) <= self._stamp <= read.stamp:
            return read.stamp      # the clock of the stamps was set since an earlier read
        self._delays.append(delay)
        return self._stamp

    def values(self) -> List[Tuple[str, Any]]:
        """For /diagnostics; empty if the board sends no time. From any thread."""
        if self._ticks is None:
            return []
        delays = sorted(self._delays)
        known = [f'{self._clock.drift:.0f}', f'{delays[len(delays) // 2] * 1e3:.2f}',
                 f'{delays[-1] * 1e3:.2f}'] if delays else ['-'] * 3
        return [*zip(('board clock [ppm]', 'read delay p50 [ms]', 'read delay max [ms]'), known),
                ('clock errors', self._errors)]
