"""How late a command is, by the stamp that its sender put on it.

The clocks of two hosts may differ by any amount, so a delay says nothing alone; but the smallest
one seen is that of a command that nothing held up, and all beyond it is lateness.
"""
from typing import Any, Dict, Optional

_DRIFT = 1e-3        # s a second by which two clocks may drift apart; also of one that is slewed
_CLOCK_SET = 5.0     # s of commands that are all equally late after which a clock has been set


class _Sender:
    """One connection of one sender."""

    def __init__(self, connection: Any, delay: float, now: float) -> None:
        self.connection = connection
        self.delay = delay                         # the smallest, as it may have drifted …
        self.at = now                              # … by this time
        self.late_since: Optional[float] = None    # refused ever since …
        self.late_by = 0.0                         # … with about this delay


class Lateness:
    """Of the commands of one topic.

    A sender that restarts has a new connection, on which nothing old can wait: its delays count
    anew. A clock that is set back makes all that follows late, and steadily so, where what a
    network held up comes in faster than it was sent: after 5 s of it that delay is taken for the
    smallest.

    Args:
        limit: seconds of lateness that are allowed; 0: any.
    """

    def __init__(self, limit: float) -> None:
        self._limit = limit
        self._senders: Dict[str, _Sender] = {}

    def of(self, sender: str, connection: Any, stamp: float, now: float) -> float:
        """Seconds by which this command is late if that is more than allowed, or 0.

        Args:
            sender: its name.
            connection: anything that is another object after a reconnect.
            stamp: s, of the sender's clock; 0: none.
            now: s, of ours, which nobody may set.
        """
        if not stamp or not self._limit:
            return 0.0
        delay = now - stamp
        known = self._senders.get(sender)
        if known is None or known.connection is not connection:
            self._senders[sender] = _Sender(connection, delay, now)
            return 0.0
        known.delay = min(delay, known.delay + (now - known.at) * _DRIFT)
        known.at = now
        late = delay - known.delay
        if late <= self._limit:
            known.late_since = None
            return 0.0
        if known.late_since is None or abs(delay - known.late_by) > self._limit:
            known.late_since, known.late_by = now, delay
        elif now - known.late_since >= _CLOCK_SET:
            self._senders[sender] = _Sender(connection, delay, now)
            return 0.0
        return late
