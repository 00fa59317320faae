"""Opens a port, again after each failure, for its reader: a link, a simulated board, a tool.

Opening runs in a separate thread: over a network it takes seconds, and some devices hang.
"""
import queue
import threading
import time
from typing import Callable, Optional

from .port import Port, PortError

_BACK_OFF = (0.1, 1.0)    # s between two tries: the first pause, the longest


def _nothing_is_due(_now: float) -> Optional[float]:
    return None


class Opener:
    """Opens one port on request, until `end`.

    Its thread is started once, at the beginning: starting a thread when memory has run out may
    never return.

    Args:
        port: the port to open; its reader closes it.
        name: of the thread.
    """

    def __init__(self, port: Port, name: str) -> None:
        self.ending = threading.Event()      # `end` has been called
        self._port = port
        self._pause = 0.0                    # s until the next try
        self._trouble = ''                   # why the latest try failed; '': the port is open
        self._tried = threading.Event()      # that try has ended
        self._orders: queue.SimpleQueue = queue.SimpleQueue()   # its get() takes no memory
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def end(self) -> None:
        """Stop opening the port; returns at once, also while an opening hangs."""
        self.ending.set()
        self._orders.put(False)
        self._tried.set()

    def open(self, failed: Callable[[str], None],
             idle: Callable[[float], Optional[float]] = _nothing_is_due) -> bool:
        """Open the port; return True as soon as it is open, or False after `end`.

        Args:
            failed: called with the reason after each try that failed.
            idle: called meanwhile with the time (time.monotonic); returns when to call it next at
                the latest, or None.
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
            self._trouble = 'out of memory while opening it'
            try:
                self._trouble = self._try()
            except BaseException:  # pylint: disable=broad-except
                pass        # too little memory even for the text of the error
            if self.ending.is_set():
                self._port.close()      # `open` has returned already
            self._tried.set()

    def _try(self) -> str:
        try:
            if not self._port.is_open:      # an earlier order may have opened it
                self._port.open()
        except PortError as error:
            return str(error)
        except BaseException as error:  # pylint: disable=broad-except
            return f'fault while opening it: {error!r}'
        return ''
