"""Opens a port again and again, for whoever reads it: a link, a simulated board, a tool.

An opening runs in a thread of its own: over a network it takes seconds, and some devices hang.
"""
import queue
import threading
import time
from typing import Callable, Optional

from .port import Port, PortError

_BACK_OFF = (0.1, 1.0)    # s from one try to the next: first, last


def _nothing_is_due(_now: float) -> Optional[float]:
    return None


class Opener:
    """Opens one port whenever it is asked to, until it is told to end.

    Its thread is there from the start: where no memory is left, starting one may never return.

    Args:
        port: what is to be opened; whoever reads it closes it.
        name: of the thread.
        opened: is called in the thread as soon as the port is open.
    """

    def __init__(self, port: Port, name: str, opened: Callable[[], None] = lambda: None) -> None:
        self.ending = threading.Event()      # `end` has been called
        self._port = port
        self._opened = opened
        self._pause = 0.0                    # s until the next try
        self._trouble = ''                   # why the latest one failed; '': the port is open
        self._tried = threading.Event()      # it has come to its end
        self._orders: queue.SimpleQueue = queue.SimpleQueue()   # waiting there takes no memory
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def end(self) -> None:
        """Open it no more; returns at once, also where an opening hangs."""
        self.ending.set()
        self._orders.put(False)
        self._tried.set()

    def open(self, failed: Callable[[str], None],
             idle: Callable[[float], Optional[float]] = _nothing_is_due) -> bool:
        """Return True as soon as the port is open, and False when `end` is called.

        Args:
            failed: is called after each try that failed, with the reason.
            idle: is called meanwhile with the time, by time.monotonic; returns when to be called
                next at the latest, or None.
        """
        if self._port.is_open:
            return True
        while not self.ending.is_set():
            self._wait(self.ending, self._pause, idle)
            self._pause = min(max(self._pause * 2, _BACK_OFF[0]), _BACK_OFF[1])
            self._tried.clear()
            self._orders.put(True)
            while not self._tried.is_set() and not self.ending.is_set():
                self._wait(self._tried, _BACK_OFF[1], idle)
            if self.ending.is_set():
                break
            if not self._trouble:
                self._pause = _BACK_OFF[0]
                return True
            self._port.close()
            failed(self._trouble)
        self._port.close()
        return False

    def _wait(self, until: threading.Event, seconds: float,
              idle: Callable[[float], Optional[float]]) -> None:
        now = time.monotonic()
        end = now + seconds
        while now < end and not until.is_set() and not self.ending.is_set():
            due = idle(now)
            until.wait(max((end if due is None else min(due, end)) - now, 0.0))
            now = time.monotonic()

    def _run(self) -> None:
        while self._orders.get() and not self.ending.is_set():
            self._trouble = 'there is no memory left to open it'
            try:
                self._trouble = self._try()
            except BaseException:  # pylint: disable=broad-except
                pass        # not even enough for the text of what was raised
            if self.ending.is_set():
                self._port.close()      # nobody waits for it any more
            self._tried.set()

    def _try(self) -> str:
        try:
            if not self._port.is_open:      # by an order whose end nobody waited for
                self._port.open()
            self._opened()
        except PortError as error:
            return str(error)
        except BaseException as error:  # pylint: disable=broad-except
            return f'fault as it was opened: {error!r}'
        return ''
