"""Whether what was written leaves the port, and when."""

LONGEST_WAIT = 0.3     # s that bytes may wait in a port that sends nothing
NETWORK_WAIT = 1.0     # s, likewise: a network may pause


class Line:
    """Compares what was written with what still waits in the kernel. Times are in s.

    Some drivers report too much for a moment: cdc_acm, that of most native USB boards, counts 1280
    bytes for each write until the USB transfer ends. So the number that waits decides nothing by
    itself, but only whether what was written earlier has left at some time since.

    Args:
        byte_time: s that the line needs for a byte.
    """

    def __init__(self, byte_time: float, is_network: bool) -> None:
        self.stands = False     # what waited was dropped, and nothing has left since
        self.is_cut = True      # the latest packet may have been sent in part
        self.free_at = 0.0      # when the line will have sent the latest
        self._longest = NETWORK_WAIT if is_network else LONGEST_WAIT
        self._byte_time = byte_time
        self._written = 0       # bytes
        self._marked = 0        # as many of them have to leave
        self._marked_at = 0.0

    def sent_at(self, size: int, now: float) -> float:
        """When so many bytes will have been sent if they are written now."""
        return max(self.free_at, now) + size * self._byte_time

    def wrote(self, size: int, now: float) -> None:
        """So many bytes were written."""
        self._written += size
        self.free_at = self.sent_at(size, now)
        self.is_cut = False

    def is_stuck(self, waiting: int, now: float, longest: float = 0.0) -> bool:
        """Whether nothing has left for `longest` s, by default the usual time, beyond what the line
        needs for it. To be called often, with the number of bytes that wait."""
        left = self._written - waiting
        if left < self._marked:
            return now - self._marked_at > (longest or self._longest) + max(
                0.0, self.free_at - now)
        self.stands &= left == self._marked
        self._marked, self._marked_at = self._written, now
        return False

    def dropped(self, now: float) -> None:
        """What waited was dropped."""
        self._marked, self._marked_at, self.free_at = self._written, now, now
        self.is_cut = True
