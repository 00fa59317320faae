"""Opens a port in a thread of its own: over a network it takes seconds, and some devices hang."""
import queue
import threading
from typing import Callable

from .port import Port, PortError


class Opener:
    """Opens one port when it is asked to.

    Its thread is there from the start: where no memory is left, starting one may never return.

    Args:
        port: what is to be opened.
        name: of the thread.
        opened: is called in the thread as soon as the port is open.
    """

    def __init__(self, port: Port, name: str, opened: Callable[[], None]) -> None:
        self.done = threading.Event()     # the opening that was asked for has ended
        self.trouble = ''                 # why it failed; '': the port is open
        self._port = port
        self._opened = opened
        self._orders: queue.SimpleQueue = queue.SimpleQueue()   # waiting there takes no memory
        self._ending = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def begin(self) -> None:
        """Have the port opened; `done` tells when that has succeeded or failed."""
        self.done.clear()
        self._orders.put(True)

    def end(self) -> None:
        """Open it no more; returns at once, also where an opening hangs."""
        self._ending = True
        self._orders.put(False)
        self.done.set()

    def _run(self) -> None:
        while self._orders.get() and not self._ending:
            self.trouble = 'there is no memory left to open it'
            try:
                self.trouble = self._try()
            except BaseException:  # pylint: disable=broad-except
                pass        # not even enough for the text of what was raised
            if self._ending:
                self._port.close()      # nobody waits for it any more
            self.done.set()

    def _try(self) -> str:
        try:
            self._port.open()
            self._opened()
        except PortError as error:
            return str(error)
        except BaseException as error:  # pylint: disable=broad-except
            return f'fault as it was opened: {error!r}'
        return ''
