"""Threads that call a step again and again."""
import threading
import time
import traceback
from contextlib import suppress
from typing import Callable

from ..transport.pace import set_priority
from .sparing_log import SparingLog

_AFTER_FAULT = 0.1      # s until a thread goes on after an unexpected error
_REALTIME_PRIORITY = 20


def start(name: str, step: Callable[[], float], log: SparingLog) -> threading.Thread:
    """Start a thread that calls a step, which sleeps until it is due, and returns when it is due
    next, until that is never. Errors of the step, and a lack of memory, do not end it."""
    def run() -> None:
        due = 0.0
        while due < float('inf'):
            try:
                due = step()
            except BaseException:  # pylint: disable=broad-except
                with suppress(BaseException):       # there may be too little memory to log it
                    log.error('fault', traceback.format_exc())
                time.sleep(_AFTER_FAULT)

    thread = threading.Thread(target=run, name=name, daemon=True)
    thread.start()
    return thread


def prefer(thread: threading.Thread) -> str:
    """Give a thread that runs real-time priority; return a log line: whether it has that."""
    if set_priority(_REALTIME_PRIORITY, thread.native_id or 0):
        return 'the heartbeat has real-time priority'
    return ('no real-time priority for the heartbeat: it may be late while the computer is '
            f'busy. To allow it, put the line "@dialout - rtprio {_REALTIME_PRIORITY}" into a '
            'file in /etc/security/limits.d/, add the user to that group, and log in again')
