"""A thread for calls to the ROS master, so that pages and the car need not wait while it hangs."""
import threading
import time
import traceback
from typing import Callable, Dict

from ...link.sparing_log import SparingLog

_PAUSE = 0.1      # s between two rounds: a page may change what it shows 100 times a second


class Registrar:
    """Runs functions one after the other in a thread.

    A function that waits for its turn is not queued a second time.
    """

    def __init__(self, log: SparingLog) -> None:
        self._log = log
        self._waiting: Dict[Callable[[], None], None] = {}      # an ordered set
        self._lock = threading.Lock()
        self._wake = threading.Event()
        threading.Thread(target=self._run, name='registrar', daemon=True).start()

    def submit(self, function: Callable[[], None]) -> None:
        """Run this function soon. May be called from any thread."""
        with self._lock:
            self._waiting[function] = None
        self._wake.set()

    def _run(self) -> None:
        while True:
            self._wake.wait()
            self._wake.clear()
            with self._lock:
                functions, self._waiting = list(self._waiting), {}
            for function in functions:
                try:
                    function()
                except Exception:  # pylint: disable=broad-except
                    # A master that ends, and rospy as it shuts down, may raise anything.
                    self._log.error('registering', traceback.format_exc())
            time.sleep(_PAUSE)
