"""A thread for whatever asks the ROS master: while that hangs, pages and the car do not wait."""
import threading
import time
import traceback
from typing import Callable, Dict

from ...link.sparing_log import SparingLog

_PAUSE = 0.1      # s from one round to the next: pages may change their mind 100 times a second


class Registrar:
    """Runs functions one by one in a thread of its own; one that is due already is due once."""

    def __init__(self, log: SparingLog) -> None:
        self._log = log
        self._due: Dict[Callable[[], None], None] = {}      # in order
        self._lock = threading.Lock()
        self._news = threading.Event()
        threading.Thread(target=self._run, name='registrar', daemon=True).start()

    def do(self, job: Callable[[], None]) -> None:
        """Run this soon; from any thread."""
        with self._lock:
            self._due[job] = None
        self._news.set()

    def _run(self) -> None:
        while True:
            self._news.wait()
            self._news.clear()
            with self._lock:
                jobs, self._due = list(self._due), {}
            for job in jobs:
                try:
                    job()
                except Exception:  # pylint: disable=broad-except
                    # Whatever a master that ends, or rospy as it shuts down, may raise.
                    self._log.error('registering', traceback.format_exc())
            time.sleep(_PAUSE)
