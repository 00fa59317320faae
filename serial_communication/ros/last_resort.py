"""Ends a process that does not end by itself."""
import os
import threading
import time
from typing import Callable


class LastResort:
    """Ends the process soon after its end has begun, whatever keeps it alive: a thread in a dead
    connection, say, or a terminal that takes nothing.

    Its thread is there from the start: where no memory is left, starting one may never return.

    Args:
        seconds: from `begin` until the process ends.
        end: ends the process with a status.
    """

    def __init__(self, seconds: float, end: Callable[[int], None] = os._exit) -> None:
        self._seconds = seconds
        self._end = end
        self._status = 0
        self._begun = threading.Event()
        threading.Thread(target=self._run, name='last resort', daemon=True).start()

    def begin(self, status: int = 0) -> None:
        """The end has begun, with this status."""
        self._status = status
        self._begun.set()

    def _run(self) -> None:
        self._begun.wait()
        time.sleep(self._seconds)
        self._end(self._status)
