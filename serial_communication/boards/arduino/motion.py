"""Decides when a heartbeat has to be sent, and the zero of a motion: that of the drive motor, or of
another row that moves something.

Pure rules: no port, no thread, no clock. `now` is in seconds of a clock that also runs while the
computer is suspended. The session asks what is due, and reports what it has sent.
"""
from typing import Any, Optional

from ...transport.pace import Every

_LONGEST_GAP = 0.025     # s between two heartbeats on the line
_REPEAT_PERIOD = 0.05   # s between the repetitions of a stop: the line may lose any of them
_REPEAT_FOR = 1.0       # s after the first zero for which it is repeated
_EARLY = 0.005          # s by which a repetition may be early, instead of one heartbeat late
_NEVER = float('-inf')


class Motion:
    """The state of one motion, as far as the bridge can know it: unknown at first, since the board
    may hold that of a bridge that crashed.

    Args:
        zero: the message that ends it.
        timeout: s after the last command until the zero is due; 0: never.
    """

    def __init__(self, zero: Any, timeout: float) -> None:
        self.zero = zero
        self.moves = True            # the board may hold another value than the zero
        self.is_unknown = True       # the zero has to be sent before anything else
        self._timeout = timeout
        self._timeout_at = 0.0       # when the zero is due, if it moves
        self._repeat_at = 0.0
        self._repeat_until = _NEVER

    def sent(self, message: Any, now: float) -> None:
        """This command was written to an open port."""
        if message != self.zero:
            self.moves = True
            self._timeout_at = now + self._timeout
            return
        if self.moves:
            self._repeat_until = now + _REPEAT_FOR
        self.moves = self.is_unknown = False
        self._repeat_at = now + _REPEAT_PERIOD

    def forget(self) -> None:
        """What was written may not have been sent, or has to be ended at once."""
        self.moves = self.is_unknown = True

    def due(self, now: float, board_reads: bool = True) -> bool:
        """Whether the zero has to be sent now: the motion is not known, or is not commanded any
        more, or the line may have lost the zero before.

        Args:
            board_reads: False: no repetitions; the board calibrates, and would read all of them
                minutes later.
        """
        if self.is_unknown:
            return True
        if self.moves:
            return self._timeout > 0 and now >= self._timeout_at
        repeat_at = self._repeat_at - _EARLY
        if now > self._repeat_until + _REPEAT_PERIOD:    # missed repetitions are not sent later
            return False
        return board_reads and repeat_at <= now and repeat_at <= self._repeat_until


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
