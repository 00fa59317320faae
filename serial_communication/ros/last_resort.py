"""Ends a process even if something hangs."""
import os
import threading
import time
from typing import Callable


class LastResort:
    """Ends the process a fixed time after its shutdown has begun, even if a thread hangs.

    Its thread starts at once, since starting a thread may never return when memory runs out.

    Args:
        seconds: time from `begin` until the process ends.
        end: ends the process with a status.
    """

    def __init__(self, seconds: float, end: Callable[[int], None] = os._exit) -> None:
        self._seconds = seconds
        self._end = end
        self._status = 0
        self._begun = threading.Event()
        threading.Thread(target=self._run, name='last resort', daemon=True).start()

    def begin(self, status: int = 0) -> None:
        """Start the countdown; the process will end with this status, or that of an earlier call
        if it is not 0."""
        self._status = self._status or status
        self._begun.set()

    def _run(self) -> None:
        self._begun.wait()
        time.sleep(self._seconds)
        self._end(self._status)
