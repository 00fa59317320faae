"""For how long written bytes wait in a port before they are sent."""
from .port import Port

LONGEST_WAIT = 0.3     # s that bytes may wait in a port that sends nothing: then it is blocked


class OutputWatch:
    """Compares what was written with what still waits in the kernel.

    Some drivers report too much for a moment: cdc_acm, that of most native USB boards, counts 1280
    bytes for each write until the USB transfer ends. So the number that waits decides nothing by
    itself, but only whether what was written earlier has left at some time since.
    """

    def __init__(self, port: Port) -> None:
        self.written = 0         # bytes; counted by the user of the port
        self.has_sent = False    # whether bytes have left since the call of `waiting_for` before
        self._port = port
        self._marked = 0         # as many of them have to leave
        self._marked_at = 0.0

    def waiting_for(self, now: float) -> float:
        """For how many s bytes have been waiting, at least; 0.0: what was written before the
        previous call has left. To be called often."""
        left = self.written - self.waiting
        if left < self._marked:
            return now - self._marked_at
        self.has_sent = left > self._marked
        self._marked, self._marked_at = self.written, now
        return 0.0

    @property
    def waiting(self) -> int:
        """How many bytes wait now, as the driver reports it."""
        return round(self._port.backlog() * self._port.baud / 10)

    def restart(self, now: float) -> None:
        """What waited was dropped, if the driver can do that."""
        self._marked, self._marked_at = self.written, now
