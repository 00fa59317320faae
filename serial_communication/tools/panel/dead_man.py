"""The dead man's switch: which browser drives the car, and when it no longer does. Pure."""
from typing import Any, Callable, Dict, NamedTuple, Optional

SILENCE = 0.2       # s without a word from the hand that holds, after which it counts as gone
FRESH = 0.3         # s that what the browser had seen as it sent may lie back


class Refused(Exception):
    """The command does not drive; the text says why."""


class Hold(NamedTuple):
    """A hand on the pad, from its press to its release."""

    who: Any        # the browser
    number: int     # counted up by it
    heard: float    # when it last said so


class DeadMan:
    """Drives only while one browser says again and again, and freshly, that it is held.

    A hold that has ended never drives again, whatever of it still comes: the browser has to let
    go and press anew. And since a network may keep messages back and deliver them all at once,
    each carries the latest time of ours that the browser had seen: one that has not seen us for
    FRESH is old, whatever clock the browser has.

    Args:
        stop: is called whenever a hold that drove has ended.
    """

    def __init__(self, stop: Callable[[], None]) -> None:
        self.hold: Optional[Hold] = None
        self._stop = stop
        self._ended: Dict[Any, int] = {}     # browser -> its latest hold that has ended

    def command(self, who: Any, number: int, seen: float, now: float) -> None:
        """A command of this hold has come; Refused if it does not drive."""
        self.check(now)
        if number <= self._ended.get(who, 0):
            raise Refused('let go and press again')
        if self.hold and self.hold.who is not who:
            raise Refused('another browser drives')
        if not 0 <= now - seen <= FRESH:
            self.release(who, number)
            raise Refused(f'the connection is too slow to drive: {1e3 * (now - seen):.0f} ms')
        if self.hold and self.hold.number != number:
            self.end()      # its release has been lost
        self.hold = Hold(who, number, now)

    def check(self, now: float) -> None:
        """End the hold if its hand has been silent for too long."""
        if self.hold and now - self.hold.heard >= SILENCE:
            self.end()

    def release(self, who: Any, number: int) -> None:
        """This hold ends."""
        self._ended[who] = max(number, self._ended.get(who, 0))
        if self.hold and self.hold.who is who and self.hold.number <= number:
            self.hold = None
            self._stop()

    def forget(self, who: Any) -> None:
        """The browser has gone."""
        if self.hold and self.hold.who is who:
            self.end()
        self._ended.pop(who, None)

    def end(self) -> None:
        """The hold that drives ends."""
        if self.hold:
            self.release(self.hold.who, self.hold.number)
