"""Decides when the zero of a motion has to be sent: that of the drive motor, or of another row that
moves something.

Pure rules: no port, no thread, no clock. `now` is in seconds of a clock that also runs while the
computer is suspended. The session asks what is due, and reports what it has sent.
"""
import enum
from typing import Any, Optional

_REPEAT_PERIOD = 0.05   # s between the repetitions of a stop: the line may lose any of them
_REPEAT_FOR = 1.0       # s after the first zero for which it is repeated
_EARLY = 0.005          # s by which a repetition may be early, instead of one heartbeat late
_NEVER = float('-inf')


class Stop(enum.Enum):
    """Why a zero has to be sent."""

    UNKNOWN = 'the board may hold any motion'
    TIMED_OUT = 'no command for too long'
    REPEATED = 'the line may have lost the zero before'


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

    def due(self, now: float, board_reads: bool = True) -> Optional[Stop]:
        """Why the zero has to be sent now, or None.

        Args:
            board_reads: False: no repetitions; the board calibrates, and would read all of them
                minutes later.
        """
        if self.is_unknown:
            return Stop.UNKNOWN
        if self.moves:
            return Stop.TIMED_OUT if self._timeout and now >= self._timeout_at else None
        repeat_at = self._repeat_at - _EARLY
        if now > self._repeat_until + _REPEAT_PERIOD:    # missed repetitions are not sent later
            return None
        is_due = board_reads and repeat_at <= now and repeat_at <= self._repeat_until
        return Stop.REPEATED if is_due else None
