"""Clocks, deadlines, rate limits and thread priorities, for links and simulated boards.

Times are passed in by the caller, in seconds of one monotonic clock.
"""
import os
import time


def clock() -> float:
    """Seconds of a monotonic clock that also runs while the computer is suspended."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class Every:
    """Periodic deadlines that do not drift, the first one `period` s from `now`.

    After a stall the next deadline is one whole period later, so there is no burst.
    """

    def __init__(self, period: float, now: float) -> None:
        self.due = now + period
        self._period = period
        self._start = now
        self._count = 1     # of periods from the start to `due`

    def passed(self, now: float) -> bool:
        """Whether the deadline has passed; if so, set the next one, after `now`."""
        if now < self.due:
            return False
        self._count += 1
        self.due = self._start + self._count * self._period
        if self.due <= now:
            self._start, self._count, self.due = now, 1, now + self._period
        return True


class Allowance:
    """A rate limit, a token bucket: `burst` at once, after that `rate` per second."""

    def __init__(self, burst: int, rate: float) -> None:
        self._burst, self._rate = burst, rate
        self._left = float(burst)
        self._asked_at = 0.0

    def take(self, now: float) -> bool:
        """Whether one more is allowed at `now`; if so, count it."""
        self._left = min(self._burst, self._left + (now - self._asked_at) * self._rate)
        self._asked_at = now
        if self._left < 1:
            return False
        self._left -= 1
        return True


def set_priority(priority: int, thread: int = 0) -> bool:
    """Give a thread (its native id; 0: the calling one) a priority of SCHED_FIFO, 1 … 99, or
    ordinary scheduling, 0; return whether the system allowed it."""
    try:
        os.sched_setscheduler(thread, os.SCHED_FIFO if priority else os.SCHED_OTHER,
                              os.sched_param(priority))
    except (OSError, AttributeError):
        return False
    return True


def set_priority_of_all(priority: int) -> None:
    """Give every thread of this process a priority, as `set_priority`; new threads inherit it."""
    for thread in os.listdir('/proc/self/task'):
        set_priority(priority, int(thread))
