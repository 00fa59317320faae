"""Threads that go on whatever fails."""
import threading
import time
import traceback
from typing import Any, Callable, Dict, Tuple

import rospy

from ..link.sparing_log import SparingLog
from .logs import sparing_log

_PAUSE = 0.1      # s between two rounds of a worker: who submits may do so all the time


def repeat(name: str, function: Callable[[], None]) -> None:
    """Call a function again and again in a thread of this name; what it raises is logged."""
    log = sparing_log(name)

    def run() -> None:
        while True:
            _call(log, function)

    threading.Thread(target=run, name=name, daemon=True).start()


def _call(log: SparingLog, function: Callable[..., None], *arguments: Any) -> None:
    try:
        function(*arguments)
    except Exception:  # pylint: disable=broad-except
        # A master that ends, and rospy as it shuts down, may raise anything.
        if not rospy.is_shutdown():
            log.error('fault', traceback.format_exc())


class LatestWorker:
    """Calls functions in its thread, one after the other: calls that may take any time.

    A function that is submitted again before its turn is called once, with the newest arguments.
    """

    def __init__(self, name: str) -> None:
        self._log = sparing_log(name)
        self._waiting: Dict[Callable[..., None], Tuple] = {}
        self._lock = threading.Lock()
        self._wake = threading.Event()
        repeat(name, self._round)

    def submit(self, function: Callable[..., None], *arguments: Any) -> None:
        """Have this function called soon. May be called from any thread."""
        with self._lock:
            self._waiting[function] = arguments
        self._wake.set()

    def _round(self) -> None:
        self._wake.wait()
        self._wake.clear()
        with self._lock:
            waiting, self._waiting = self._waiting, {}
        for function, arguments in waiting.items():
            _call(self._log, function, *arguments)
        time.sleep(_PAUSE)
