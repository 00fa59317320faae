"""Decides when the zero of a motion has to be sent: that of the drive motor, or of another row that
moves something.

Pure rules: no port, no thread, no clock. `now` is in seconds of a clock that also runs while the
computer is suspended. The session asks what is due, and reports what it has sent.
"""
from typing import Any

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
