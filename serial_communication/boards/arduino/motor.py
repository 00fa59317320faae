"""Decides when SPEED 0 has to be sent to the drive motor.

Pure rules: no port, no thread, no clock. `now` is in seconds of a clock that also runs while the
computer is suspended. The link asks what is due, and reports what it has sent.
"""
import enum
from typing import Optional

from ...link.stall import StallWatch

REPEAT_PERIOD = 0.05    # s between the repetitions of a stop: the line may lose any of them
REPEAT_FOR = 1.0        # s after the first SPEED 0 for which it is repeated
EARLY = 0.005           # s by which a repetition may be early, instead of one heartbeat late
STALL = 0.5              # s without a run of the heartbeat thread; fixed, whatever speed_timeout is


class Stop(enum.Enum):
    """Why SPEED 0 has to be sent."""

    UNKNOWN_SPEED = 'the board may hold any speed'
    TIMED_OUT = 'no speed command for too long'
    REPEATED = 'the line may have lost the SPEED 0 before'


class Motor:
    """The state of one drive motor, as far as the bridge can know it: unknown at first, since the
    board may hold the speed of a bridge that crashed.

    Args:
        speed_timeout: s after the last speed command until SPEED 0 is due; 0: never.
    """

    def __init__(self, speed_timeout: float, now: float) -> None:
        self.moving = True           # the board may hold a speed other than 0
        self.speed_unknown = True    # SPEED 0 has to be sent before anything else
        self._speed_timeout = speed_timeout
        self._timeout_at = now       # when SPEED 0 is due, if moving
        self._repeat_at = 0.0
        self._repeat_until = float('-inf')
        self._stalls = StallWatch(STALL, now)

    def sent(self, speed: int, now: float) -> None:
        """This speed was written to an open port."""
        if speed:
            self.moving = True
            self._timeout_at = now + self._speed_timeout
            return
        if self.moving:
            self._repeat_until = now + REPEAT_FOR
        self.moving = self.speed_unknown = False
        self._repeat_at = now + REPEAT_PERIOD

    def forget_speed(self) -> None:
        """What was written may not have been sent: output was dropped, or the port closed."""
        self.moving = self.speed_unknown = True

    def due(self, now: float, board_reads: bool = True) -> Optional[Stop]:
        """Why SPEED 0 has to be sent now, or None.

        Args:
            board_reads: False: no repetitions; the board calibrates, and would read all of them
                minutes later.
        """
        if self.speed_unknown:
            return Stop.UNKNOWN_SPEED
        if self.moving:
            return Stop.TIMED_OUT if self._speed_timeout and now >= self._timeout_at else None
        repeat_at = self._repeat_at - EARLY
        if now > self._repeat_until + REPEAT_PERIOD:    # missed repetitions are not sent later
            return None
        is_due = board_reads and repeat_at <= now and repeat_at <= self._repeat_until
        return Stop.REPEATED if is_due else None

    def detect_stall(self, now: float, receiving_at: float = float('inf')) -> Optional[float]:
        """The length in s of a stall that is detected now, or None.

        Has to be called before anything is sent: the board may hold an old speed, and commands
        from the time of the stall arrive all at once after it.

        Args:
            receiving_at: when the receiving threads last ran; infinite: there is nothing to
                receive. A stall of these threads alone is detected while it lasts.
        """
        known_already = self.ignores_commands(now)
        seconds = self._stalls.stalled_for(now, receiving_at)
        if not seconds or known_already:
            return None
        self.forget_speed()
        return seconds

    def awake(self, now: float) -> None:
        """The heartbeat thread runs: nothing but a stall of the process can hold it up."""
        self._stalls.awake_at = now

    def ignores_commands(self, now: float) -> bool:
        """Whether a command that arrives now may be from the time of a stall."""
        return self._stalls.has_just_stalled(now)
