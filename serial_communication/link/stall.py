"""Finds stalls: times in which the bridge did not run, or a thread of it."""
STALL = 0.3            # s between two reads; longer is a stall
AFTER_STALL = 0.5      # s after a stall in which what waited meanwhile may still arrive
LONGEST_SLEEP = 0.1    # s; a link's thread never sleeps longer in a read


class StallWatch:
    """Watches one thread, which runs from `now` on; any thread may ask.

    A time longer than `limit` in which it does not run is a stall. Times are seconds of a clock
    that also runs while the computer is suspended.
    """

    def __init__(self, limit: float, now: float = float('inf')) -> None:
        self.awake_at = now      # when the thread last ran; infinite: it has not been started
        self._limit = limit
        self._until = float('-inf')

    def stalled_for(self, now: float, receiving_at: float = float('inf')) -> float:
        """The length in s of a stall that ends now, or still lasts; 0.0 if there is none.

        The caller may run before the threads that stalled: all of them wake up in any order.
        `receiving_at` is when another thread last ran, which is watched as well.
        """
        seconds = now - min(self.awake_at, receiving_at)
        if seconds <= self._limit:
            return 0.0
        self._until = max(self._until, now + AFTER_STALL)
        return seconds

    def has_just_stalled(self, now: float) -> bool:
        """Whether what arrives now may have waited during a stall that `stalled_for` has found.

        Behind a port are other buffers (a USB adapter's, socat's), so not only what the kernel has
        when the stall ends is old.
        """
        return now < self._until
