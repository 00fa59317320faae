"""The line between a simulated board and its port, with its faults.

Frames leave in the order in which they were sent, as on any serial line: a delayed frame delays
all frames behind it.
"""
import math
from collections import deque
from typing import Any, Callable, Deque, Optional, Tuple

from ..transport.port import PortBusy, PortError
from .faults import Faults

_MOST_WAITING = 4096   # frames; with more in the queue one is lost


class SimulatedLine:
    """One board's line. All times are seconds of one monotonic clock, passed in as `now`.

    Args:
        board: gets this object as its ``line``.
        write: writes bytes to the port; raises PortBusy or PortError if it cannot.
        faults: None: no faults.
        note: called with (time, event, fields) for programs that check a bridge.
        say: called with lines for people.
    """

    def __init__(self, board: Any, write: Callable[[bytes], None],
                 faults: Optional[Faults] = None,
                 note: Callable[[float, str, dict], None] = lambda now, event, fields: None,
                 say: Callable[[str], None] = lambda text: None) -> None:
        self.board = board
        self.faults = faults or Faults()
        self.sends_time = self.faults.drift is not None
        self.frames = 0                # sent by the board, those that faults lost included
        self.say = say
        self._write = write
        self._note = note
        self._now = 0.0
        self._powered_at = 0.0         # when the board was switched on, or reset
        self._queue: Deque[Tuple[float, bytes]] = deque()     # when to write what
        self._silent_until = 0.0
        self._stalled_until = 0.0
        self._up_at: Optional[float] = None    # when a reset ends; None: there is none now
        board.line = self

    # -- for the runner -----------------------------------------------------------------

    def start(self, now: float) -> None:
        """Switch the board on."""
        self.faults.start(now)
        self._power_on(now)

    def closed(self) -> None:
        """The port was closed: what waits is lost."""
        self._queue.clear()

    def receive(self, data: bytes, now: float) -> None:
        """Pass received bytes to the board, unless it is in a reset."""
        self._now = now
        data = self.faults.damaged(data, 'rx-')
        if data and self._up_at is None:
            self.board.receive(data, now)

    def tick(self, now: float) -> Optional[float]:
        """Do what is due, write what is ready; return when to be called next at the latest."""
        self._now = now
        for kind, seconds in self.faults.events(now):
            self.begin(kind, seconds, now)
        if self._up_at is not None and now >= self._up_at:
            self._up_at = None
            self._power_on(now)
        times = [self.board.tick(now) if self._up_at is None else self._up_at,
                 self.faults.next_event()]
        if self.stalled(now):
            times.append(self._stalled_until)
        while self._queue and self._queue[0][0] <= now:
            self._put(self._queue.popleft()[1])
        if self._queue:
            times.append(self._queue[0][0])
        return min((time for time in times if time is not None), default=None)

    def stalled(self, now: float) -> bool:
        """Whether a fault keeps the board from reading the port."""
        return now < self._stalled_until

    def begin(self, kind: str, seconds: float, now: float) -> None:
        """Begin a silence, a stall or a reset."""
        self._now = now
        if kind == 'silence':
            self._silent_until = max(self._silent_until, now + seconds)
            self.say(f'fault: silent for {seconds:.1f} s')
        elif kind == 'stall':
            self._stalled_until = max(self._stalled_until, now + seconds)
            self.say(f'fault: reads nothing for {seconds:.1f} s')
        else:
            self.say(f'fault: reset, up again in {seconds:.1f} s')
            if self._up_at is None:
                self.board.power_off(now)
            self._up_at = now + seconds
            self.send_raw(self.board.CHATTER)

    # -- for the board ------------------------------------------------------------------

    def send(self, frame: bytes) -> None:
        """Send a frame."""
        self.frames += 1
        self.send_raw(self.faults.damaged(frame), self.faults.delay())

    def send_raw(self, data: bytes, delay: float = 0.0) -> None:
        """Send bytes that are not a frame, or no longer."""
        if not data or self._now < self._silent_until or len(self._queue) >= _MOST_WAITING:
            return
        at, batch = self._now + delay, self.faults.batch
        if batch:
            at = math.ceil(at / batch) * batch
        if self._queue:
            at = max(at, self._queue[-1][0])
        if at > self._now or self._queue:
            self._queue.append((at, data))
        else:
            self._put(data)

    def micros(self) -> int:
        """The board's clock: µs since it was switched on, modulo 2 ** 32."""
        pace = 1e6 + (self.faults.drift or 0.0)
        return round((self._now - self._powered_at) * pace) % 2 ** 32

    def note(self, event: str, **fields: Any) -> None:
        """Tell a program that checks a bridge what happens."""
        self._note(self._now, event, fields)

    # -- inside -------------------------------------------------------------------------

    def _power_on(self, now: float) -> None:
        self._now = self._powered_at = now
        self.note('boot')
        self.board.power_on(now)

    def _put(self, data: bytes) -> None:
        try:
            self._write(data)
        except (PortBusy, PortError):
            pass        # lost, as on a line that nobody reads
