"""How far a long program is: on a terminal one line that is rewritten, elsewhere plain lines."""
import shutil
import sys
import threading
import time
from contextlib import contextmanager
from typing import Callable, Iterator, Optional, TextIO

_REWRITTEN = 0.5     # s from one look of the line on a terminal to the next
_REPEATED = 60.0     # s from one line of the same phase to the next elsewhere


class Progress:
    """Lines about what is done, each with the seconds since the start.

    Args:
        out: where they go.
        total: seconds that all of it takes, about; 0: not known.
    """

    def __init__(self, out: Optional[TextIO] = None, total: float = 0.0,
                 clock: Callable[[], float] = time.monotonic) -> None:
        self.total = total
        self._out = out or sys.stderr
        self._clock = clock
        self._began = clock()
        self._terminal = self._out.isatty()
        self._line = ''              # that stands on the terminal and will be rewritten
        self._lock = threading.Lock()

    @property
    def seconds(self) -> float:
        """Since the start."""
        return self._clock() - self._began

    def say(self, text: str) -> None:
        """A line that stays."""
        with self._lock:
            self._out.write(f'{self._erase()}{self.seconds:5.0f} s  {text}\n{self._line}')
            self._out.flush()

    @contextmanager
    def phase(self, text: str, note: Callable[[], str] = lambda: '') -> Iterator[None]:
        """While this lasts, it is what is done; `note` says what is known of it so far."""
        self.say(text)
        ended = threading.Event()

        def run() -> None:
            while not ended.wait(_REWRITTEN if self._terminal else _REPEATED):
                self._show(', '.join(filter(None, (text, self._left(), note()))))

        thread = threading.Thread(target=run, name='progress', daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()
            with self._lock:
                self._out.write(self._erase())
                self._out.flush()
                self._line = ''

    def _show(self, text: str) -> None:
        if not self._terminal:
            self.say(text)
            return
        with self._lock:
            erase = self._erase()
            columns = shutil.get_terminal_size().columns - 1
            self._line = f'{self.seconds:5.0f} s  {text}'[:columns]
            self._out.write(erase + self._line)
            self._out.flush()

    def _left(self) -> str:
        left = self.total - self.seconds
        if not self.total:
            return ''
        return f'{left:.0f} of {self.total:.0f} s left' if left > 0 else 'soon done'

    def _erase(self) -> str:
        return '\r\033[K' if self._line else ''
