"""The child side of the bench: a process that reads orders from stdin, one JSON object per line.

The bench runs its boards and ROS nodes as child processes, since a measured program must not share
an interpreter with the program that measures it. No rospy here, since boards do not need it.
"""
import json
import os
import random
import sys
import time
from typing import Callable, Iterator

_SPIN = 0.0002       # s of busy waiting before a deadline


def serve(**handlers: Callable) -> None:
    """Execute orders until stdin ends; {"do": NAME, ...} calls handlers[NAME](...).

    Only answers go to stdout; other output goes to stderr.
    """
    answers = os.fdopen(os.dup(1), 'w')
    os.dup2(2, 1)
    for line in sys.stdin:
        order = json.loads(line)
        print(json.dumps(handlers[order.pop('do')](**order)), file=answers, flush=True)
    os._exit(0)


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
