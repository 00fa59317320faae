"""A thread for calls that may take any time, of which only the newest count."""
import threading
import time
from typing import Any, Callable, Dict, Tuple


class LatestWorker:
    """Calls functions in its thread, one after the other.

    A function that is submitted again before its turn is called once, with the newest arguments.

    Args:
        name: of the thread.
        pause: s between two rounds: who submits may do so all the time.
        failed: called with what a function raises.
    """

    def __init__(self, name: str, pause: float, failed: Callable[[Exception], None]) -> None:
        self._pause = pause
        self._failed = failed
        self._waiting: Dict[Callable[..., None], Tuple] = {}
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Start the thread; what was submitted before is called, too."""
        self._thread.start()

    def submit(self, function: Callable[..., None], *arguments: Any) -> None:
        """Have this function called soon. May be called from any thread."""
        with self._lock:
            self._waiting[function] = arguments
        self._wake.set()

    def _run(self) -> None:
        while True:
            self._wake.wait()
            self._wake.clear()
            with self._lock:
                waiting, self._waiting = self._waiting, {}
            for function, arguments in waiting.items():
                try:
                    function(*arguments)
                except Exception as error:  # pylint: disable=broad-except
                    # A master that ends, and rospy as it shuts down, may raise anything.
                    self._failed(error)
            time.sleep(self._pause)
