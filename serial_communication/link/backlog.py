"""The backlog: bytes that waited in a port while its link's thread stalled. They are dropped.

Behind the port are other buffers (a network peer's kernel, a USB adapter, socat), which pass on
their bytes only as the port is read. So bytes are dropped until they arrive no faster than the
board can send them.
"""

STALL = 0.3            # s between two reads; longer is a stall
LONGEST_SLEEP = 0.1    # s; a link's thread never sleeps longer in a read
# The rate of the received bytes is measured over a part of the stall, within limits: on a busy
# computer long queues move unevenly.
_PART_OF_STALL = 0.25
_WINDOW = 0.1, 1.0     # s: the shortest, the longest
_FASTER = 1.5          # times the line's rate; bytes that arrive faster have waited somewhere
_LONGEST = 10.0        # s after which bytes are accepted at any rate


class Backlog:
    """The backlog of one stall.

    Args:
        baud: of the line; gives the rate at which a board can send.
        seconds: length of the stall.
        now: seconds of a clock that also runs while the computer is suspended.
    """

    def __init__(self, baud: int, seconds: float, now: float) -> None:
        self.size = 0          # bytes dropped
        self.last = b''        # the bytes of the latest read that had some
        self.seconds = 0.0
        self._limit = baud / 10.0 * _FASTER      # bytes a second
        self.extend(seconds, now)

    def extend(self, seconds: float, now: float) -> None:
        """Another stall happened meanwhile: measure the rate again."""
        self.seconds += seconds
        self._window = min(max(_WINDOW[0], self.seconds * _PART_OF_STALL), _WINDOW[1])
        self._end = now + _LONGEST
        self._begin_window(now)

    def drop(self, data: bytes, now: float) -> bool:
        """Count the bytes of one read as dropped; return whether the backlog ends with them."""
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
