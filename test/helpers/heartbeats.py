"""What the times at which heartbeats were read say of when they were sent."""
import glob

BEAT_MISSED = 0.030   # s without a heartbeat after which the board stops its motor


class HeartbeatWatch:
    """Whether a bridge misses a heartbeat from now on.

    Args:
        car: the board's end of the line, with `forget` and `longest_gap`.
        pid: of the bridge.
    """

    def __init__(self, car, pid):
        self._car, self._pid = car, pid
        self._waited = processor_wait(pid)
        car.forget()

    def check(self):
        """AssertionError if it has missed one by its own fault."""
        gap, waited = self._car.longest_gap(), processor_wait(self._pid) - self._waited
        said = (f'longest gap between heartbeats {gap * 1e3:.1f} ms, waited for a processor '
                f'{waited * 1e3:.1f} ms')
        print(said)
        assert gap - waited < BEAT_MISSED, said


def longest_gap(stamps, rate):
    """Between two heartbeats as they were sent: no less than this, in s.

    That this test was late to read them, or the line to pass them on, is not counted. Neither can
    hold a heartbeat back without those behind it, and a bridge that was late does not make up for
    those that it missed: so each left at least as many periods before a later one as it has places
    before it, however they came, in one read or in several.

    Args:
        stamps: when each was read, in s.
        rate: heartbeats a second.
    """
    stamps = sorted(stamps)
    longest, sent = 0.0, stamps[-1]      # the latest moment at which it can have left
    for stamp, before in zip(stamps[:0:-1], stamps[-2::-1]):
        sent = min(stamp, sent)
        longest = max(longest, sent - before)
        sent -= 1.0 / rate
    return longest


def processor_wait(pid):
    """For how long a process's threads have waited for a processor so far, in s.

    A user who may not have real-time priority shares the processor with whatever else runs: what a
    heartbeat waited for it is none of the bridge's doing. With that priority it is next to nothing.
    """
    waited = 0
    for path in glob.glob('/proc/%d/task/*/schedstat' % pid):
        try:
            with open(path) as file:
                waited += int(file.read().split()[1])
        except (OSError, ValueError, IndexError):
            pass        # the thread has ended
    return waited / 1e9
