"""Finds stalls: times in which a thread of the bridge did not run. What comes after one may be old.
"""
from typing import Any, Callable, Dict

STALL = 0.5     # s in which a loop does not run; longer is a stall
FRESH = 0.5     # s after a stall in which what waited meanwhile may still arrive
_NEVER = float('-inf')


def stall(seconds: float) -> str:
    """What to say where a loop did not run for so long; '': that was no stall."""
    return f'the bridge stalled for {seconds:.3g} s' if seconds > STALL else ''


class Freshness:
    """Watches the loops of one link; any thread may ask. Times are in s of a clock that also runs
    while the computer is suspended.

    Behind a port are other buffers (a USB adapter's, socat's), and threads wake up in any order. So
    what comes within `FRESH` after a stall counts as old, too.
    """

    def __init__(self) -> None:
        self._awake: Dict[str, float] = {}      # when each loop ran last
        self._ended = _NEVER                    # when the latest stall ended
        self._stamp: Any = None                 # the same as a stamp

    def awake(self, loop: str, now: float, stamp: Callable[[], Any] = lambda: None) -> str:
        """A loop runs; return what to say of the stall that this ends, or ''."""
        found = stall(now - self._awake.get(loop, now))
        self._awake[loop] = now
        if found:
            self._ended, self._stamp = now, stamp()
        return found

    def rest(self, loop: str) -> None:
        """A loop waits for something else: that is no stall."""
        self._awake.pop(loop, None)

    def is_fresh(self, now: float, stamp: Any = None) -> bool:
        """Whether what comes now cannot have waited during a stall, or while one lasts: what was
        made after its end is fresh at once."""
        awake = list(self._awake.values())      # another thread may add one
        if any(now - at > STALL for at in awake):
            return False
        return now >= self._ended + FRESH or \
            None not in (stamp, self._stamp) and stamp > self._stamp
