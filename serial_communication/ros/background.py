"""Threads that go on whatever fails."""
import threading
import time
import traceback
from typing import Any, Callable, Dict, Tuple

import rospy

from .logs import sparing_log

_PAUSE = 0.1      # s between two calls of a worker: who submits may do so all the time


def repeat(name: str, function: Callable[[], None]) -> None:
    """Call a function again and again in a thread of this name; what it raises is logged."""
    log = sparing_log(name)

    def run() -> None:
        while True:
            try:
                function()
            except Exception:  # pylint: disable=broad-except
                # A master that ends, and rospy as it shuts down, may raise anything.
                if not rospy.is_shutdown():
                    log.error('fault', traceback.format_exc())

    threading.Thread(target=run, name=name, daemon=True).start()


class LatestWorker:
    """Calls functions in its thread, one after the other: calls that may take any time.

    A function that is submitted again before its turn is called once, with the newest arguments.
    """

    def __init__(self, name: str) -> None:
        self._waiting: Dict[Callable[..., None], Tuple] = {}
        self._changed = threading.Condition()
        repeat(name, self._next)

    def submit(self, function: Callable[..., None], *arguments: Any) -> None:
        """Have this function called soon. May be called from any thread."""
        with self._changed:
            self._waiting[function] = arguments
            self._changed.notify()

    def _next(self) -> None:
        time.sleep(_PAUSE)
        with self._changed:
            self._changed.wait_for(lambda: self._waiting)
            function = next(iter(self._waiting))
            arguments = self._waiting.pop(function)
        function(*arguments)
