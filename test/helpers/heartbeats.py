"""Finds out when heartbeats were sent, from the times at which they were read."""
import glob

BEAT_MISSED = 0.030   # s without a heartbeat after which the board stops its motor


class HeartbeatWatch:
    """Checks that from now on a bridge sends its heartbeats in time.

    Args:
        car: the board's end of the line, with `forget` and `longest_gap`.
        pid: of the bridge.
    """

    def __init__(self, car, pid):
        self._car, self._pid = car, pid
        self._waited = processor_wait(pid)
        car.forget()

    def check(self):
        """AssertionError if a gap was too long, not counting the wait for a processor."""
        gap, waited = self._car.longest_gap(), processor_wait(self._pid) - self._waited
        result = (f'longest gap between heartbeats {gap * 1e3:.1f} ms, waited for a processor '
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


def processor_wait(pid):
    """How long the threads of a process have waited for a processor so far, in s.

    Without real-time priority the bridge shares the processor with other programs, so a heartbeat
    may be late through no fault of the bridge. With real-time priority the wait is close to 0.
    """
    waited = 0
    for path in glob.glob('/proc/%d/task/*/schedstat' % pid):
        try:
            with open(path) as file:
                waited += int(file.read().split()[1])
        except (OSError, ValueError, IndexError):
            pass        # the thread has ended
    return waited / 1e9
