"""Opens a port, again after each failure, for its reader: a link, a simulated board, a tool.

Opening runs in a separate thread: over a network it takes seconds, and some devices hang.
"""
import queue
import threading
import time
from contextlib import suppress
from typing import Callable, Optional

from .port import Port
from .port_errors import PortError

_BACK_OFF = (0.1, 1.0)    # s before a try: the first pause, the longest


class Opener:
    """Opens one port on request, until `end`; its reader closes it.

    Its thread, of this name, is started once: starting a thread when memory has run out may never
    return.
    """

    def __init__(self, port: Port, name: str) -> None:
        self.ending = threading.Event()      # `end` has been called
        self._port = port
        self._pause = 0.0                    # s before the next try
        self._is_trying = False              # the result of a try has not been taken yet
        # For each try the pause before it, and why it failed or ''. Their get() takes no memory.
        self._tries: 'queue.SimpleQueue[float]' = queue.SimpleQueue()
        self._results: 'queue.SimpleQueue[str]' = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        self._thread.start()

    def end(self) -> None:
        """Stop opening the port, and make a read of it return now.

        Returns at once, also while an opening hangs.
        """
        self.ending.set()
        self._tries.put(0.0)
        self._results.put('')
        self._port.wake()

    def open(self, failed: Callable[[str], None],
             idle: Callable[[float], Optional[float]] = lambda now: None) -> bool:
        """Open the port; return True as soon as it is open, or False after `end`.

        `failed` is called with the reason after each try that failed. `idle` is called meanwhile
        with the time (time.monotonic), and returns when to call it next at the latest, or None.
        """
        while not self.ending.is_set():
            if self._port.is_open and not self._is_trying:
                self._pause = _BACK_OFF[0]
                return True
            if not self._is_trying:
                self._tries.put(self._pause)
                self._is_trying = True
                self._pause = min(max(self._pause * 2, _BACK_OFF[0]), _BACK_OFF[1])
            trouble = self._result(idle)
            self._is_trying = False
            if trouble and not self.ending.is_set():
                failed(trouble)
        self._port.close()
        return False

    def _result(self, idle: Callable[[float], Optional[float]]) -> str:
        while True:
            now = time.monotonic()
            due = idle(now)
            wait = _BACK_OFF[1] if due is None else min(max(due - now, 0.0), _BACK_OFF[1])
            with suppress(queue.Empty):
                return self._results.get(timeout=wait)

    def _run(self) -> None:
        while True:
            time.sleep(self._tries.get())
            if self.ending.is_set():
                return
            trouble = 'out of memory while opening it'
            try:
                trouble = self._try()
            except BaseException:  # pylint: disable=broad-except
                pass        # too little memory even for the text of the error
            if trouble or self.ending.is_set():     # then `open` may have returned already
                self._port.close()
            self._results.put(trouble)

    def _try(self) -> str:
        try:
            self._port.open()
        except PortError as error:
            return str(error)
        except BaseException as error:  # pylint: disable=broad-except
            return f'fault while opening it: {error!r}'
        return ''
