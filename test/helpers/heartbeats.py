"""Finds out when heartbeats were sent, from the times at which they were read."""
import time

from witness import Witness, priority_of

BEAT_MISSED = 0.030   # s without a heartbeat after which the board stops its motor


class HeartbeatWatch:
    """Checks that from now on a bridge sends its heartbeats in time.

    Args:
        car: the board's end of the line, with `forget` and `longest_gap`.
        pid: of the bridge.
    """

    def __init__(self, car, pid):
        self._car, self._witness = car, Witness(priority_of(pid))
        self._since = time.monotonic()
        car.forget()

    def check(self):
        """AssertionError if a gap was too long, less what a witness had to wait (witness.py)."""
        waited = max(self._witness.late(self._since, time.monotonic()), default=0.0)
        self._witness.end()
        gap = self._car.longest_gap()
        result = (f'longest gap between heartbeats {gap * 1e3:.1f} ms, a witness waited '
                  f'{waited * 1e3:.1f} ms')
        print(result)
        assert gap - waited < BEAT_MISSED, result


def longest_gap(stamps, rate):
    """The longest gap between two heartbeats when they were sent, in s: at least this long.

    Delays of the line and of this test's reads do not count. They delay all heartbeats behind one,
    too, and a late bridge does not catch up on missed heartbeats. So a heartbeat that is n places
    before another one was sent at least n periods earlier, in however many reads they arrived.

    Args:
        stamps: when each was read, in s.
        rate: heartbeats per second.
    """
    stamps = sorted(stamps)
    longest, sent = 0.0, stamps[-1]      # the latest time at which it can have been sent
    for stamp, before in zip(stamps[:0:-1], stamps[-2::-1]):
        sent = min(stamp, sent)
        longest = max(longest, sent - before)
        sent -= 1.0 / rate
    return longest
