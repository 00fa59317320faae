"""What the drive motor was told, and when it must be told SPEED 0.

Pure rules: no port, no thread, no clock. `now` is in seconds of a clock that also runs while the
computer is suspended. Whoever owns the port asks what is due, and says what has been sent.
"""
import enum
from typing import Optional

_REPEAT_PERIOD = 0.05    # s from one SPEED 0 of a stop to the next …
_REPEAT_FOR = 1.0        # … until so long after the first: the line may lose any of them
_EARLY = 0.005           # s by which the next one may be early, lest it waits for another heartbeat
_STALL = 0.5             # s without the heart at work that make a stall; no parameter changes it
_OLD_COMMANDS = 0.5      # s after a stall in which what was commanded meanwhile still comes


class Stop(enum.Enum):
    """Why SPEED 0 has to be sent."""

    IN_DOUBT = 'the board may hold any speed'
    TIMED_OUT = 'no speed has been commanded for too long'
    REPEATED = 'the line may have lost the one before'


class Motor:
    """The motor of one car, as far as its board can have been told.

    A new one is in doubt: the board may hold the speed of a bridge that crashed.

    Args:
        speed_timeout: seconds after the last speed until SPEED 0 is due; 0: never.
    """

    def __init__(self, speed_timeout: float, now: float) -> None:
        self.moving = True           # the last speed that the board has may be another than 0
        self.in_doubt = True         # SPEED 0 has to leave before anything else does
        self._speed_timeout = speed_timeout
        self._speed_due = now        # when SPEED 0 follows by itself, if moving
        self._repeat_at = 0.0
        self._repeat_until = float('-inf')
        self._awake_at = now
        self._ignores_until = now

    def sent(self, speed: int, now: float) -> None:
        """This speed has been handed to an open port."""
        if speed:
            self.moving = True
            self._speed_due = now + self._speed_timeout
            return
        if self.moving:
            self._repeat_until = now + _REPEAT_FOR
        self.moving = self.in_doubt = False
        self._repeat_at = now + _REPEAT_PERIOD

    def expect_any_speed(self) -> None:
        """What was sent may not have left (dropped output, a closed port)."""
        self.moving = self.in_doubt = True

    def due(self, now: float, board_reads: bool = True) -> Optional[Stop]:
        """Why SPEED 0 has to be sent now, or None.

        Args:
            board_reads: False: it calibrates, and would read every repetition minutes later.
        """
        if self.in_doubt:
            return Stop.IN_DOUBT
        if self.moving:
            return Stop.TIMED_OUT if self._speed_timeout and now >= self._speed_due else None
        repeat_at = self._repeat_at - _EARLY
        if now > self._repeat_until + _REPEAT_PERIOD:      # they were held back until then
            return None
        is_due = board_reads and repeat_at <= now and repeat_at <= self._repeat_until
        return Stop.REPEATED if is_due else None

    def noticed_stall(self, now: float, receiving_at: float = float('inf')) -> Optional[float]:
        """The seconds of a stall that has just been noticed, or None.

        To be asked before anything is sent: the board may hold an old speed, and what was
        commanded during the stall comes now, all at once.

        Args:
            receiving_at: when the threads that receive were last at work; infinite: there is
                nothing to receive. Where they stall alone, that is noticed while it lasts.
        """
        seconds = now - min(self._awake_at, receiving_at)
        if seconds <= _STALL:
            return None
        noticed_before = self.ignores_commands(now)
        self._awake_at = now
        self._ignores_until = now + _OLD_COMMANDS
        if noticed_before:
            return None
        self.expect_any_speed()
        return seconds

    def awake(self, now: float) -> None:
        """The heart's thread, which nothing but a stall keeps from it, is at work."""
        self._awake_at = now

    def ignores_commands(self, now: float) -> bool:
        """Whether a command that comes now may be of the time of a stall."""
        return now < self._ignores_until
