"""When heartbeats are due, how regular they were, and what delays them on the line.

Pure rules: no port, no thread, no clock. Times are in s.
"""
from typing import Optional

from ...transport.pace import Every

_LONGEST_GAP = 0.025     # s between two heartbeats on the line
_MOST = 0.1              # s that may be left to send before a packet; a faster port needs less
_LONGEST_PACKET = 260    # bytes


class Heartbeats:
    """The heartbeats of one link: absolute deadlines, no burst after a stall.

    Args:
        rate: heartbeats a second.
    """

    def __init__(self, rate: float) -> None:
        self.sent = 0            # since the start
        self.max_gap = 0.0       # s, since the link began anew
        self.shown_gap = 0.0     # s, what `recent_gap` returned last
        self._period = 1.0 / rate
        self.pace = Every(self._period, -self._period)      # the first one is due at once
        self._last: Optional[float] = None      # when the latest was sent, or the link began anew
        self._gap = 0.0          # s, the longest since the last call of `recent_gap`

    def begin(self, now: Optional[float]) -> None:
        """Gaps count from now on; None: the port is closed."""
        self._last, self.max_gap, self.shown_gap, self._gap = now, 0.0, 0.0, 0.0

    def count(self, now: float) -> None:
        """One was sent."""
        if self._last is not None:
            self._gap = max(self._gap, now - self._last)
            self.max_gap = max(self.max_gap, self._gap)
        self._last = now
        self.sent += 1

    def is_overdue(self, now: float) -> bool:
        """Whether their thread does not run just now."""
        return self._last is None or now > self._last + self._period + 0.02

    def recent_gap(self, now: float) -> float:
        """The longest gap since the last call, in s; the one that still lasts counts, too."""
        longest, self._gap = self._gap, 0.0
        self.shown_gap = max(longest, 0.0 if self._last is None else now - self._last)
        return self.shown_gap


class LineTime:
    """When the line will have sent what was written, by its baud rate.

    Commands that are written at once hold back the heartbeats behind them: 330 bytes take 29 ms at
    115200 baud, and after 30 ms without a heartbeat the board stops its motor. So a heartbeat has
    to be among them.

    Args:
        byte_time: s that one byte takes.
    """

    def __init__(self, byte_time: float) -> None:
        self._byte_time = byte_time
        self._most = _MOST + _LONGEST_PACKET * byte_time
        self._free_at = 0.0     # when the latest byte will have been sent
        self._beat_at = 0.0     # when the latest heartbeat will have been sent

    def wrote(self, size: int, now: float, is_heartbeat: bool) -> None:
        """So many bytes were written."""
        self._free_at = self._sent_at(size, now)
        if is_heartbeat:
            self._beat_at = self._free_at

    def waiting(self, now: float) -> float:
        """How many s the line needs for what was written."""
        return max(0.0, self._free_at - now)

    def delays_heartbeat(self, size: int, now: float) -> bool:
        """Whether the next heartbeat would be too late behind so many more bytes."""
        return self._sent_at(size, now) > self._beat_at + _LONGEST_GAP

    def _sent_at(self, size: int, now: float) -> float:
        """When so many bytes will have been sent if they are written now."""
        return now + min(self.waiting(now), self._most) + size * self._byte_time

    def restart(self) -> None:
        """What waited was dropped."""
        self._free_at = 0.0
