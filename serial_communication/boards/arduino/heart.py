"""The thread that keeps a board's motor alive, or its car standing: absolute deadlines, no burst
after a stall, and nothing that another thread does can end it."""
import threading
import time
import traceback
from collections import deque
from typing import Callable, Deque, Optional

from ...transport.pace import Every, clock, set_priority

_LONGEST_NAP = 0.02      # s; so that a slow heartbeat does not make SPEED 0 late
_REALTIME_PRIORITY = 20


class Heart:
    """Calls `work(beat)` at every deadline of `rate` and every 20 ms at the latest.

    Args:
        rate: heartbeats a second.
        work: what is to be done; `beat` says that a heartbeat is due. Returns whether one left.
        on_fault: is given the traceback of what `work` raised; the heart goes on.
        on_start: is given, in a line for people, whether it has real-time priority.
    """

    def __init__(self, name: str, rate: float, work: Callable[[bool], bool],
                 on_fault: Callable[[str], None], on_start: Callable[[str], None]) -> None:
        self.beats = 0
        self.max_gap = 0.0       # s, since `restart`
        self._period = 1.0 / rate
        self._work = work
        self._on_fault = on_fault
        self._on_start = on_start
        self._last: Optional[float] = None
        self._opened_at: Optional[float] = None
        self._gaps: Deque[float] = deque(maxlen=1000)     # since `recent_gap` was last called
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Begin to beat."""
        self._thread.start()

    def stop(self, patience: float) -> None:
        """End; wait for the thread so many seconds at most."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(patience)

    def opened(self, now: float) -> None:
        """The port is open: heartbeats are due from now on."""
        self._opened_at = now

    def restart(self) -> None:
        """Measure gaps anew: the port has closed."""
        self._last = self._opened_at = None
        self.max_gap = 0.0

    def recent_gap(self, now: float) -> float:
        """The longest gap, in s, since this was last called.

        The one that still lasts counts, too: from the latest heartbeat, or from the opening of the
        port where none has left since.
        """
        last = self._opened_at if self._last is None else self._last
        longest = 0.0 if last is None else now - last
        while self._gaps:
            longest = max(longest, self._gaps.popleft())
        return longest

    def _run(self) -> None:
        self._on_start(_told(set_priority(_REALTIME_PRIORITY)))
        pace = Every(self._period, clock() - self._period)      # the first one at once
        while not self._stopping.is_set():
            now = clock()
            beat = pace.passed(now)
            try:
                if self._work(beat):
                    self._count(now)
            except BaseException:  # pylint: disable=broad-except
                self._on_fault(traceback.format_exc())
            try:
                time.sleep(min(max(pace.due - clock(), 0.0), _LONGEST_NAP))
            except BaseException:  # pylint: disable=broad-except
                self._on_fault(traceback.format_exc())
                # Never a loop without a pause: at real-time priority it would take a whole core.
                self._stopping.wait(_LONGEST_NAP)

    def _count(self, now: float) -> None:
        last, self._last = self._last, now
        if last is not None:
            self.max_gap = max(self.max_gap, now - last)
            self._gaps.append(now - last)
        self.beats += 1


def _told(granted: bool) -> str:
    """Whether the heartbeat has real-time priority, in a line for people."""
    if granted:
        return 'the heartbeat has real-time priority'
    return ('no real-time priority for the heartbeat, which a busy computer may make late; to '
            f'allow it: the line "@dialout - rtprio {_REALTIME_PRIORITY}" in a file in '
            '/etc/security/limits.d/, a user of that group, and a new login')
