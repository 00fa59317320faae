"""What waited in a port while its link's thread stalled: old bytes, to be read and dropped.

Behind a port stand other buffers (a network peer's kernel, a USB adapter, programs that connect
pseudo terminals), which hand on what they have only as the port is read. So reading goes on until
no more comes than the board itself can send.
"""

STALL = 0.3            # s from one read to the next that make a stall …
LONGEST_SLEEP = 0.1    # … of which so many may be planned
_WINDOW = 0.1, 1.0     # s over which the rate of what comes is looked at: at least, at most …
_OF_STALL = 0.25       # … and so much of the stall: on a busy computer long queues move unevenly
_FASTER = 1.5          # times the line's own rate: that waited somewhere
_LONGEST = 10.0        # s after which even such a line is believed


class Backlog:
    """The old bytes of one stall.

    Args:
        baud: of the line, which tells how fast a board can send.
        seconds: that the stall took.
        now: s of a clock that also runs while the computer is suspended.
    """

    def __init__(self, baud: int, seconds: float, now: float) -> None:
        self.size = 0          # bytes dropped
        self.last = b''        # the latest of them
        self.seconds = 0.0
        self._limit = baud / 10.0 * _FASTER      # bytes a second
        self.extend(seconds, now)

    def extend(self, seconds: float, now: float) -> None:
        """There was another stall meanwhile."""
        self.seconds += seconds
        self._window = min(max(_WINDOW[0], self.seconds * _OF_STALL), _WINDOW[1])
        self._end = now + _LONGEST
        self._begin_window(now)

    def drop(self, data: bytes, now: float) -> bool:
        """Take what a read returned; whether it was the last one to be dropped."""
        self.size += len(data)
        self._in_window += len(data)
        self.last = data or self.last
        passed = now - self._since
        if passed < self._window:
            return False
        if self._in_window <= self._limit * passed or now >= self._end:
            return True
        self._begin_window(now)
        return False

    def _begin_window(self, now: float) -> None:
        self._since = now
        self._in_window = 0
