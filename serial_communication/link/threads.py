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


class Loop(threading.Thread):
    """Calls `step`, which returns when it is due next, until that is never.

    Args:
        wait: sleeps until then, if the step itself does not.
    """

    def __init__(self, name: str, step: Callable[[], float], log: SparingLog,
                 wait: Callable[[float], None] = lambda due: None) -> None:
        super().__init__(name=name, daemon=True)
        self._step, self._log, self._wait = step, log, wait

    def run(self) -> None:
        """Errors of the step, and a lack of memory, do not end this."""
        due = 0.0
        while due < float('inf'):
            try:
                self._wait(due)
                due = self._step()
            except BaseException:  # pylint: disable=broad-except
                with suppress(BaseException):       # there may be too little memory to log it
                    self._log.error('fault', traceback.format_exc())
                time.sleep(_AFTER_FAULT)


def prefer(thread: threading.Thread) -> str:
    """Give a thread that runs real-time priority; return a log line: whether it has that."""
    if set_priority(_REALTIME_PRIORITY, thread.native_id or 0):
        return 'the heartbeat has real-time priority'
    return ('no real-time priority for the heartbeat: it may be late while the computer is '
            f'busy. To allow it, put the line "@dialout - rtprio {_REALTIME_PRIORITY}" into a '
            'file in /etc/security/limits.d/, add the user to that group, and log in again')
