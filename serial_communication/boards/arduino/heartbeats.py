"""When heartbeats are due, and how regular they were.

Pure rules: no port, no thread, no clock. Times are in s.
"""
from typing import Optional

from ...transport.pace import Every

_LONGEST_GAP = 0.025     # s between two heartbeats on the line


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
        self._leaves_at = 0.0    # when the line will have sent the latest

    def begin(self, now: Optional[float]) -> None:
        """Gaps count from now on; None: the port is closed."""
        self._last, self.max_gap, self.shown_gap, self._gap = now, 0.0, 0.0, 0.0

    def count(self, now: float, leaves_at: float) -> None:
        """One was written, which the line will have sent then."""
        self._leaves_at = leaves_at
        if self._last is not None:
            self._gap = max(self._gap, now - self._last)
            self.max_gap = max(self.max_gap, self._gap)
        self._last = now
        self.sent += 1

    def is_late(self, leaves_at: float) -> bool:
        """Whether the next one would be too late behind what the line will have sent then.

        Commands that are written at once hold back the heartbeats behind them: 330 bytes take 29 ms
        at 115200 baud, and after 30 ms without a heartbeat the board stops its motor. So a
        heartbeat has to be among them.
        """
        return leaves_at > self._leaves_at + _LONGEST_GAP

    def is_overdue(self, now: float) -> bool:
        """Whether their thread does not run just now."""
        return self._last is None or now > self._last + self._period + 0.02

    def recent_gap(self, now: float) -> float:
        """The longest gap since the last call, in s; the one that still lasts counts, too."""
        longest, self._gap = self._gap, 0.0
        self.shown_gap = max(longest, 0.0 if self._last is None else now - self._last)
        return self.shown_gap
