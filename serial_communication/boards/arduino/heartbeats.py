"""When heartbeats are due, and how regular they were. Pure rules; times are in s."""
from collections import deque
from typing import Deque, Optional

from ...transport.pace import Every


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
        self._pace: Optional[Every] = None      # None: not begun
        self._last: Optional[float] = None      # when the latest was sent, or the link began anew
        self._gaps: Deque[float] = deque(maxlen=1000)     # s, since the last call of `recent_gap`

    def is_due(self, now: float) -> bool:
        """Whether one is due; the first one at once."""
        if self._pace is None:
            self._pace = Every(self._period, now - self._period)
        return self._pace.passed(now)

    @property
    def due(self) -> float:
        """When the next one is due."""
        return self._pace.due if self._pace else 0.0

    def begin(self, now: Optional[float]) -> None:
        """Gaps count from now on; None: the port is closed."""
        self._last, self.max_gap, self.shown_gap = now, 0.0, 0.0
        self._gaps.clear()

    def count(self, now: float) -> None:
        """One was sent."""
        if self._last is not None:
            self.max_gap = max(self.max_gap, now - self._last)
            self._gaps.append(now - self._last)
        self._last = now
        self.sent += 1

    def is_overdue(self, now: float) -> bool:
        """Whether their thread does not run just now."""
        return self._last is None or now > self._last + self._period + 0.02

    def recent_gap(self, now: float) -> float:
        """The longest gap since the last call, in s; the one that still lasts counts, too."""
        longest = 0.0 if self._last is None else now - self._last
        while self._gaps:
            longest = max(longest, self._gaps.popleft())
        self.shown_gap = longest
        return longest
