"""The dead man's switch: which page drives the car, and when it must stop. Pure."""
from typing import Any, Callable, Dict, NamedTuple, Optional

SILENCE = 0.2       # s without a command from the page that drives, after which the car stops
MAX_AGE = 0.3       # s since the update that a page had seen when it sent a command


class CommandRefused(Exception):
    """The command is not executed; the text says why."""


class Hold(NamedTuple):
    """One press of the driving pad, until its release."""

    page: Any
    number: int           # counted up by the page
    received_at: float    # when its latest command was received


class DeadManSwitch:
    """Lets the car drive only while one page repeats, in time, that its pad is held.

    A hold that has ended never drives again, whatever command of it arrives later: the user has to
    let go and press again. A network may also delay messages and deliver them all at once.
    Therefore each command carries the time of the latest update that the page had seen, by this
    machine's clock. A command is too old if that update was sent more than MAX_AGE ago.

    Args:
        stop: is called whenever a hold that drove has ended.
    """

    def __init__(self, stop: Callable[[], None]) -> None:
        self.hold: Optional[Hold] = None
        self._stop = stop
        self._ended: Dict[Any, int] = {}     # page -> number of its latest hold that has ended

    def command(self, page: Any, number: int, seen: float, now: float) -> None:
        """Take a command that was received.

        Args:
            number: of the hold that the command belongs to.
            seen: time of the latest update that the page had seen, s.

        Raises:
            CommandRefused: the command must not drive the car.
        """
        self.check(now)
        if number <= self._ended.get(page, 0):
            raise CommandRefused('let go and press again')
        if self.hold and self.hold.page is not page:
            raise CommandRefused('another page drives')
        if not 0 <= now - seen <= MAX_AGE:
            self.release(page, number)
            raise CommandRefused(f'the connection is too slow to drive: {1e3 * (now - seen):.0f} '
                                 f'ms, at most {1e3 * MAX_AGE:.0f} ms')
        if self.hold and self.hold.number != number:
            self.end()      # its release has been lost
        self.hold = Hold(page, number, now)

    def check(self, now: float) -> None:
        """End the hold if its page has been silent for too long."""
        if self.hold and now - self.hold.received_at >= SILENCE:
            self.end()

    def release(self, page: Any, number: int) -> None:
        """End this hold of the page, and those before it."""
        self._ended[page] = max(number, self._ended.get(page, 0))
        if self.hold and self.hold.page is page and self.hold.number <= number:
            self.hold = None
            self._stop()

    def forget(self, page: Any) -> None:
        """End the page's hold, if any: its connection is closed."""
        if self.hold and self.hold.page is page:
            self.end()
        self._ended.pop(page, None)

    def end(self) -> None:
        """End the hold that drives, if any."""
        if self.hold:
            self.release(self.hold.page, self.hold.number)
