"""Waits for a ROS master."""
import threading
import time
from contextlib import suppress
from typing import Callable

import rosgraph

from ...ros.master import ask

_ASK_EVERY = 0.1                           # s
_FIRST_REPORT, _REPORT_EVERY = 3.0, 10.0   # s of waiting


def wait_for_master(stopping: threading.Event,
                    say: Callable[[str], object],
                    patience: float = float('inf')) -> bool:
    """Wait for a ROS master, for `patience` s at most; return whether one answers.

    Args:
        stopping: ends the waiting when set.
        say: called with a line of text after 3 s, then every 10 s.
    """
    uri, began = rosgraph.get_master_uri(), time.monotonic()
    due = began + _FIRST_REPORT
    while not stopping.is_set() and time.monotonic() < began + patience:
        with suppress(Exception):
            ask(uri, 'getPid')
            return True
        if time.monotonic() >= due:
            say(f'waiting for the ROS master at {uri}; start one with roscore, or set '
                'ROS_MASTER_URI')
            due = time.monotonic() + _REPORT_EVERY
        stopping.wait(_ASK_EVERY)
    return False
