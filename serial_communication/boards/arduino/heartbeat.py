"""The thread that sends heartbeats and stops: absolute deadlines, no burst after a stall, and no
other thread can end it."""
import threading
import time
import traceback
from collections import deque
from typing import Callable, Deque, Optional

from ...transport.pace import Every, set_priority

_LONGEST_SLEEP = 0.02    # s; a low heartbeat rate must not make SPEED 0 late
_REALTIME_PRIORITY = 20


class HeartbeatThread:
    """Calls `work(heartbeat_due)` at the given rate, and every 20 ms at the latest.

    Args:
        rate: heartbeats a second.
        work: sends what is due; returns whether it sent a heartbeat.
        on_fault: called with the traceback of what `work` raised; the thread continues.
        now: the clock.
    """

    def __init__(self, name: str, rate: float, work: Callable[[bool], bool],
                 on_fault: Callable[[str], None], now: Callable[[], float]) -> None:
        self.sent = 0            # heartbeats, since the start
        self.max_gap = 0.0       # s, since the port closed last
        self._period = 1.0 / rate
        self._work = work
        self._on_fault = on_fault
        self._now = now
        self._pace: Optional[Every] = None      # None: not begun
        self._last: Optional[float] = None
        self._opened_at: Optional[float] = None
        self._gaps: Deque[float] = deque(maxlen=1000)     # s, since the last call of `recent_gap`
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> str:
        """Start the thread; return a log line: whether it has real-time priority."""
        self._thread.start()
        if set_priority(_REALTIME_PRIORITY, self._thread.native_id or 0):
            return 'the heartbeat has real-time priority'
        return ('no real-time priority for the heartbeat: it may be late while the computer is '
                f'busy. To allow it, put the line "@dialout - rtprio {_REALTIME_PRIORITY}" into a '
                'file in /etc/security/limits.d/, add the user to that group, and log in again')

    def stop(self, timeout: float) -> None:
        """End the thread; wait for it at most `timeout` s."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(timeout)

    def port_opened(self, now: float) -> None:
        """The port is open: gaps count from now on."""
        self._opened_at = now

    def port_closed(self) -> None:
        """The port is closed: forget the gaps."""
        self._last = self._opened_at = None
        self.max_gap = 0.0

    def recent_gap(self, now: float) -> float:
        """The longest gap between heartbeats since the last call, in s.

        The gap that still lasts counts, too: from the latest heartbeat, or from the opening of the
        port if none was sent since.
        """
        last = self._opened_at if self._last is None else self._last
        longest = 0.0 if last is None else now - last
        while self._gaps:
            longest = max(longest, self._gaps.popleft())
        return longest

    def step(self) -> float:
        """Do what is due; return when to be called next, at the latest."""
        now = self._now()
        if self._pace is None:
            self._pace = Every(self._period, now - self._period)     # the first heartbeat at once
        try:
            if self._work(self._pace.passed(now)):
                self._count(now, self._now())
        except BaseException:  # pylint: disable=broad-except
            self._on_fault(traceback.format_exc())
        return min(self._pace.due, self._now() + _LONGEST_SLEEP)

    def _run(self) -> None:
        while not self._stopping.is_set():
            due = self.step()
            try:
                time.sleep(max(due - self._now(), 0.0))
            except BaseException:  # pylint: disable=broad-except
                self._on_fault(traceback.format_exc())
                # Without a pause, this loop would take a whole core at real-time priority.
                self._stopping.wait(_LONGEST_SLEEP)

    def _count(self, began: float, ended: float) -> None:
        """Count a heartbeat that was sent between these times."""
        last, self._last = self._last, began
        if last is not None:
            gap = ended - last      # never shorter than on the line, however long sending took
            self.max_gap = max(self.max_gap, gap)
            self._gaps.append(gap)
        self.sent += 1
