"""The dead man's switch of the pad: which page drives, and when it must stop. Pure."""
from typing import Any, Callable, Collection, Dict, NamedTuple, Optional

SILENCE = 0.2       # s without a command from the page that drives, after which all stops
MAX_AGE = 0.3       # s since the update that a page had seen when it sent a command


class CommandRefused(Exception):
    """The command is not executed; the text says why."""


class Hold(NamedTuple):
    """One press of the pad, until its release."""

    page: Any
    number: int             # counted up by the page
    moves: Collection[str]  # names of what it drives
    received_at: float      # when its latest command was received


class DeadManSwitch:
    """Drives only while one page repeats, in time, that its pad is held.

    A hold that has ended never drives again, whatever command of it arrives later: the user has to
    let go and press again. A network may also delay messages and deliver them all at once.
    Therefore a command is refused if the latest update that its page had seen is older than
    MAX_AGE, by this machine's clock.

    Args:
        stop: is called with what was driven whenever a hold has ended.
    """

    def __init__(self, stop: Callable[[Collection[str]], None]) -> None:
        self.hold: Optional[Hold] = None
        self._stop = stop
        self._ended: Dict[Any, int] = {}     # page -> number of its latest hold that has ended

    def command(self, hold: Hold, seen: float) -> None:
        """Take a command whose page has seen the update of `seen`, s; CommandRefused if it must
        not drive."""
        page, number, moves, now = hold
        self.check(now)
        if number <= self._ended.get(page, 0):
            raise CommandRefused('let go and press again')
        if self.hold and self.hold.page is not page:
            raise CommandRefused('another page drives')
        if not 0 <= now - seen <= MAX_AGE:
            self.release(page, number)
            raise CommandRefused(f'the connection is too slow to drive: {1e3 * (now - seen):.0f} '
                                 f'ms, at most {1e3 * MAX_AGE:.0f} ms')
        if self.hold and (self.hold.number, self.hold.moves) != (number, moves):
            self.end()      # its release has been lost
        self.hold = hold

    def check(self, now: float) -> None:
        """End the hold if its page has been silent for too long."""
        if self.hold and now - self.hold.received_at >= SILENCE:
            self.end()

    def release(self, page: Any, number: int) -> None:
        """End this hold of the page, and those before it."""
        self._ended[page] = max(number, self._ended.get(page, 0))
        if self.hold and self.hold.page is page and self.hold.number <= number:
            moves, self.hold = self.hold.moves, None
            self._stop(moves)

    def forget(self, page: Any) -> None:
        """End the page's hold, if any: its connection is closed."""
        if self.hold and self.hold.page is page:
            self.end()
        self._ended.pop(page, None)

    def end(self) -> None:
        """End the hold that drives, if any."""
        if self.hold:
            self.release(self.hold.page, self.hold.number)
