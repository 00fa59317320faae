"""The child side of the bench: a process that reads orders from stdin, one JSON object per line.

The bench runs its boards and ROS nodes as child processes, since a measured program must not share
an interpreter with the program that measures it. No rospy here, since boards do not need it.
"""
import ctypes
import json
import os
import random
import sys
import time
from typing import Callable, Iterator

_PR_SET_TIMERSLACK = 29
_SPIN = 0.0002       # s of busy waiting before a deadline


def serve(**handlers: Callable) -> None:
    """Execute orders until stdin ends; {"do": NAME, ...} calls handlers[NAME](...).

    Only answers go to stdout; other output goes to stderr.
    """
    answers = os.fdopen(os.dup(1), 'w')
    os.dup2(2, 1)

    def answer(value) -> None:
        answers.write(json.dumps(value) + '\n')
        answers.flush()

    answer('ready')
    for line in sys.stdin:
        order = json.loads(line)
        answer(handlers[order.pop('do')](**order))
    os._exit(0)


def set_board_priority(priority: int) -> None:
    """Set real-time priority (1 … 99) and exact sleeps, as far as the system allows it.

    A board is another computer, so load on the robot's computer must not delay it.
    """
    ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError:
        pass


def sleep_until(due: float) -> None:
    """Sleep until a monotonic time."""
    time.sleep(max(0.0, due - time.monotonic()))


def wait_until(due: float) -> None:
    """Wait until a monotonic time, to within a few µs, with busy waiting at the end."""
    sleep_until(due - _SPIN)
    while time.monotonic() < due:
        pass


def jittered(start: float, rate: float, seconds: float) -> Iterator[float]:
    """Yield times at `rate` Hz on average, each at a random place in its period."""
    for index in range(round(rate * seconds)):
        yield start + (index + random.random()) / rate
