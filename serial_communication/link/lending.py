"""Lends a port to another program, and resets its board."""
import threading
from typing import Callable

from ..framing.layout import readable
from ..transport.port import Port, PortError
from .outcome import Refused
from .session import Session
from .writer import STALLED, Writer

LONGEST_LOAN = 10.0    # s, from each call
_LONGEST_NAME = 60     # characters
_LEAVES = 0.1          # s for what stops to leave the port before the board is reset


class Lending:
    """The loans of one port; any thread may call the methods. Refused: nothing has changed.

    A loan ends by itself, whatever happens to who asked for it: after 10 s at most the link opens
    the port again, as soon as no other program has it open.
    """

    def __init__(self, port: Port, session: Session, writer: Writer,
                 now: Callable[[], float]) -> None:
        self.reset_line = ''        # `dtr` or `rts`, which resets the board; '': none does
        self.by = ''                # who has or had the latest loan, for people; '': nobody
        self.until = float('-inf')  # s, monotonic; when it ends
        self.closed = threading.Event()     # the port is closed
        self._port, self._session, self._writer, self._now = port, session, writer, now

    @property
    def runs(self) -> bool:
        """Whether a loan runs."""
        return self._now() < self.until

    def lend(self, by: str, seconds: float) -> str:
        """Close the port and leave it alone for so many seconds from now on, at most 10; 0 ends the
        loan. The same name may change its loan at any time. The port is closed when `closed` is
        set."""
        by = readable(by).strip()[:_LONGEST_NAME]
        if not by or not seconds >= 0:
            raise Refused(f'by is {by!r} and seconds {seconds:g}: a name and 0 … 10 are needed',
                          'value')
        with self._session.lock:
            if seconds:
                until, text = self._now() + min(seconds, LONGEST_LOAN), f'lent to {by}'
                self._let_go(by, text)
                self.by, self.until = by, until
                self._port.give_up(text)
                return text
            if self.runs and by == self.by:
                self.until = float('-inf')
            self._port.wake()
            return 'the port is opened again'

    def reset(self) -> str:
        """Reset the board by its control line."""
        with self._session.lock:
            if not self.reset_line or self._port.hides:
                raise Refused(f'the port {self._port.url} has no line that resets its board '
                              '(parameter reset_line)', 'value')
            if not self._port.is_open and not self.runs:
                raise Refused('the port is closed', 'port')
            self._let_go('', '')
            self._port.drain(_LEAVES)
            try:
                self._port.pulse(self.reset_line)
            except PortError as error:
                raise Refused(str(error), 'port') from None
            self._session.was_reset()
            by = f'reset by {self.reset_line.upper()}'
            self._writer.begin_anew(f'the board was {by}')
            return by

    def _let_go(self, by: str, why: str) -> None:
        """Stop what moves, where the port may be given up."""
        if self.runs and by != self.by:
            raise Refused(f'the port is lent to {self.by}', 'lent')
        if not self._writer.fresh.is_fresh(self._now()):
            raise Refused(STALLED, 'stall')
        if self._port.is_open:
            under_way = self._session.under_way(is_reset=not why)
            if under_way:
                raise Refused(f'not now: {under_way}', 'under way')
            self._writer.stop(why)
