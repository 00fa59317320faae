"""Whether the machine let a process of the bridge's own policy and priority run in time.

As a program (arguments: a descriptor of shared memory, and a processor) it is such a process: it
only sleeps, and notes when it woke up late. It uses no line and no ROS.
"""
import os
import pty
import struct
import sys
import threading
import time
import tty
from collections import deque
from typing import Callable, Deque, Tuple

LATE = 0.005             # s: a process that wakes up later than that excuses the bridge …
MARGIN = 0.05            # s … for what happened within this time of it
_PERIOD = 0.005          # s
_KEPT = 20000            # records
_RECORD = struct.Struct('<2d')      # due and awake; the first one: now, and the number of others


def sleep(memory: int, processor: int) -> None:
    os.sched_setaffinity(0, {processor})
    late = 0
    while True:
        due = time.monotonic() + _PERIOD
        time.sleep(_PERIOD)
        now = time.monotonic()
        if now - due > LATE:
            os.pwrite(memory, _RECORD.pack(due, now), (1 + late % _KEPT) * _RECORD.size)
            late += 1
        os.pwrite(memory, _RECORD.pack(now, late), 0)


class Witness:
    """Reads what such a process notes."""

    def __init__(self, start: Callable[[int], object]) -> None:
        """`start` starts the process, with this descriptor."""
        self._memory = os.memfd_create('witness', 0)
        os.pwrite(self._memory, _RECORD.pack(0.0, 0.0), 0)
        start(self._memory)

    def longest(self, since: float, until: float) -> float:
        """The longest time in s by which it woke up late in this time, or `MARGIN` beside it."""
        now = time.monotonic()
        while _RECORD.unpack(os.pread(self._memory, _RECORD.size, 0))[0] < min(until + MARGIN, now):
            time.sleep(_PERIOD)
        records = os.pread(self._memory, _RECORD.size * _KEPT, _RECORD.size)
        return max((awake - due for due, awake in _RECORD.iter_unpack(records)
                    if awake > since - MARGIN and due < until + MARGIN), default=0.0)


class LineWitness(threading.Thread):
    """Sends itself bytes through a pseudo terminal: the kernel moves them in a thread of ordinary
    priority. If that is late, a process that waits for bytes is, too."""

    def __init__(self) -> None:
        super().__init__(name='line witness', daemon=True)
        self._late: Deque[Tuple[float, float]] = deque(maxlen=1000)     # written and read
        self.start()

    def run(self) -> None:
        end, other = pty.openpty()
        tty.setraw(other)
        while True:
            written = time.monotonic()
            os.write(other, b'.')
            os.read(end, 1)
            now = time.monotonic()
            if now - written > LATE:
                self._late.append((written, now))
            time.sleep(_PERIOD)

    def longest(self, since: float, until: float) -> float:
        """The longest time in s that a byte took in this time, or `MARGIN` beside it."""
        return max((read - written for written, read in list(self._late)
                    if read > since - MARGIN and written < until + MARGIN), default=0.0)


if __name__ == '__main__':
    sleep(*map(int, sys.argv[1:]))
