"""The excuse: whether the machine let the bridge run, and moved the bytes of its lines."""
import os
import pty
import threading
import time
import tty
from collections import deque
from typing import Deque, Tuple

from .witness import LATE, Witness

MARGIN = 0.05            # s beside an event in which a late witness excuses it
STALL = 0.1              # s by which a late witness spoils more than the times of an event
_BRIDGE_PRIORITY = 1     # the lowest real-time priority of a thread of the bridge
_PERIOD = 0.005          # s


class Machine:
    """On each processor has a process of the bridge's policy and priority, which only sleeps."""

    def __init__(self) -> None:
        # As this process, none has real-time priority if the system does not allow it.
        self.real_time = os.sched_getscheduler(0) == os.SCHED_FIFO
        priority = _BRIDGE_PRIORITY if self.real_time else 0
        self._witnesses = [Witness(priority, processor, period=_PERIOD)
                           for processor in os.sched_getaffinity(0)]
        self._held: Deque[Tuple[float, float]] = deque(maxlen=10000)
        threading.Thread(target=self._move_bytes, name='line witness', daemon=True).start()

    def late(self, since: float, until: float) -> float:
        """The longest time in s by which a witness was late in this time, or `MARGIN` beside it."""
        since, until = since - MARGIN, min(until + MARGIN, time.monotonic())
        return max((late for each in self._witnesses for late in each.late(since, until)),
                   default=0.0)

    def stalled(self, since: float, until: float) -> bool:
        """Whether a witness was late by `STALL`, or the kernel took so long to move a byte through
        a pseudo terminal: one of the lines, or one that is only for this.

        The kernel does that in a thread of ordinary priority, for which the bridge waits, too.
        """
        return self.late(since, until) >= STALL or self.held(since, until) >= STALL

    def held(self, since: float, until: float) -> float:
        """The longest time in s that the kernel took to move a byte in this time."""
        return max((read - written for written, read in list(self._held)
                    if read > since - MARGIN and written < until + MARGIN), default=0.0)

    def moved(self, written: float, read: float) -> None:
        """Note when a byte was written to a pseudo terminal, and when it was read there."""
        if read - written >= LATE:
            self._held.append((written, read))

    def _move_bytes(self) -> None:
        end, other = pty.openpty()
        tty.setraw(other)
        while True:
            written = time.monotonic()
            os.write(other, b'.')
            os.read(end, 1)
            self.moved(written, time.monotonic())
            time.sleep(_PERIOD)
