"""How often, and how promptly: what a link and a simulated board need alike of a clock.

Times are the caller's, in seconds of one monotonic clock.
"""
import os
import threading
import time


def clock() -> float:
    """Seconds of a monotonic clock that also runs while the computer is suspended."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class Every:
    """Deadlines a period apart from a start: no drift; after a stall the next one is a whole
    period later, so that nothing comes in a burst."""

    def __init__(self, period: float, now: float) -> None:
        self.due = now + period
        self._period = period
        self._start = now
        self._count = 1     # of periods from the start to `due`

    def passed(self, now: float) -> bool:
        """Whether the deadline has come; if so it moves on, past `now`."""
        if now < self.due:
            return False
        self._count += 1
        self.due = self._start + self._count * self._period
        if self.due <= now:
            self._start, self._count, self.due = now, 1, now + self._period
        return True


class Allowance:
    """So many of something in a burst, and so many a second after that."""

    def __init__(self, burst: int, rate: float) -> None:
        self._burst = burst
        self._rate = rate
        self._left = float(burst)
        self._asked_at = 0.0

    def take(self, now: float) -> bool:
        """Whether there may be one more."""
        self._left = min(self._burst, self._left + (now - self._asked_at) * self._rate)
        self._asked_at = now
        if self._left < 1:
            return False
        self._left -= 1
        return True


def set_priority(priority: int, thread: int = 0) -> bool:
    """Real-time priority for a thread, or this one, where the system allows it; whether it does.

    0 is none: the ordinary one.
    """
    policy = os.SCHED_FIFO if priority else os.SCHED_OTHER
    try:
        os.sched_setscheduler(thread or threading.get_native_id(), policy,
                              os.sched_param(priority))
    except (OSError, AttributeError):
        return False
    return True


def set_priority_of_all(priority: int) -> None:
    """The same for every thread of this process, and for those that they start."""
    for thread in os.listdir('/proc/self/task'):
        set_priority(priority, int(thread))
