"""The child side of the bench: a process that takes orders on stdin, one JSON object a line.

Boards and ROS nodes of the bench are children of one program, since what is measured must not
share an interpreter with what measures it. Pure Python, no rospy: a board needs none.
"""
import ctypes
import json
import os
import random
import sys
import time
from typing import Callable, Iterator

_PR_SET_TIMERSLACK = 29
_SPIN = 0.0002       # s before a deadline that are spent looking at the clock


def serve(**handlers: Callable) -> None:
    """Carry out orders until stdin ends; {"do": NAME, ...} calls handlers[NAME](...).

    Only the answers go to stdout: what else is printed goes where stderr goes.
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


def be_a_board(priority: int) -> None:
    """Real-time priority and exact sleeps, as far as the system allows it.

    A board is another computer: what the robot's computer is busy with does not delay it.
    """
    ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError:
        pass


def sleep_until(due: float) -> None:
    """Until that monotonic time, give or take the system."""
    time.sleep(max(0.0, due - time.monotonic()))


def wait_until(due: float) -> None:
    """Until that monotonic time, to a few µs, by looking at the clock at the end."""
    sleep_until(due - _SPIN)
    while time.monotonic() < due:
        pass


def jittered(start: float, rate: float, seconds: float) -> Iterator[float]:
    """Times at `rate` on average, each anywhere in its own period: in phase with nothing."""
    for index in range(round(rate * seconds)):
        yield start + (index + random.random()) / rate
