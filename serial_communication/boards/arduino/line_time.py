"""When the line will have sent what was written, by its baud rate.

Commands that are written at once hold back the heartbeats behind them: 330 bytes take 29 ms at
115200 baud, and after 30 ms without a heartbeat the board stops its motor. So a heartbeat has to be
among them.

Pure rules: no port, no thread, no clock.
"""

_LONGEST_GAP = 0.025     # s between two heartbeats on the line
_MOST = 0.1              # s that may be left to send before a packet; a faster port needs less
_LONGEST_PACKET = 260    # bytes


class LineTime:
    """The line's own time.

    Args:
        byte_time: s that one byte takes.
    """

    def __init__(self, byte_time: float) -> None:
        self._byte_time = byte_time
        self._most = _MOST + _LONGEST_PACKET * byte_time
        self._free_at = 0.0     # when the latest byte will have been sent
        self._beat_at = 0.0     # when the latest heartbeat will have been sent

    def wrote(self, size: int, now: float) -> None:
        """So many bytes were written."""
        self._free_at = self._sent_at(size, now)

    def wrote_heartbeat(self) -> None:
        """They were a heartbeat."""
        self._beat_at = self._free_at

    def waiting(self, now: float) -> float:
        """How many s the line needs for what was written."""
        return max(0.0, self._free_at - now)

    def delays_heartbeat(self, size: int, now: float) -> bool:
        """Whether the next heartbeat would be too late behind so many more bytes."""
        return self._sent_at(size, now) > self._beat_at + _LONGEST_GAP

    def _sent_at(self, size: int, now: float) -> float:
        """When so many bytes will have been sent if they are written now."""
        return now + min(self.waiting(now), self._most) + size * self._byte_time

    def restart(self) -> None:
        """What waited was dropped."""
        self._free_at = 0.0
