"""The link to the sensor board: counts what was lost, and notices when the board falls silent."""
import time
from typing import Any, Callable, List, Optional, Tuple

from ..protocols import mcu
from ..protocols.framing import Frame
from .link import OK, WARN, Link
from .port import Port

_STATUS_PERIOD = 1.0   # s from one report of silence to the next


class McuLink(Link):
    """Frames up, nothing down.

    Args:
        timeout: seconds without a valid frame after which the board counts as silent.
        on_status: is called with each (message, seq, stamp).
        on_silence: is called once a second while the board is silent, with the classes of
            message it has sent so far (none if it never spoke), its last seq and the seconds
            since its last frame (or since the start).
    """

    def __init__(self, port: Port, timeout: float = 1.0,
                 on_status: Optional[Callable[[Any, int, Any], None]] = None,
                 on_silence: Optional[Callable[[set, int, float], None]] = None,
                 **link_arguments) -> None:
        super().__init__('mcu', port, mcu.Decoder(), **link_arguments)
        self.frames_lost = 0
        self.duplicates = 0
        self.silent = True
        self._timeout = timeout
        self._on_status = on_status
        self._on_silence = on_silence
        self._kinds: set = set()
        self._last: Optional[Frame] = None      # since the port opened
        self._last_seq = 0
        self._alive_at = time.monotonic()       # the latest valid frame, or the start
        self._next_report = self._alive_at + timeout

    def opened(self, now: float) -> None:
        self._last = None

    def received(self, frame: Frame, now: float) -> None:
        last, self._last = self._last, frame
        if last is not None:
            if last.raw == frame.raw:
                self.duplicates += 1
                return
            self.frames_lost += (frame.command - last.command - 1) % 256
        self._last_seq = frame.command
        if frame.message is None:     # sound, but of a type nobody knows
            return
        if self.silent:
            self.silent = False
            self.log.info('talks', 'the board talks')
        self._kinds.add(type(frame.message))
        self._alive_at = now
        self._next_report = now + self._timeout
        if self._on_status:
            self._on_status(frame.message, frame.command, frame.stamp)

    def tick(self, now: float) -> float:
        if now >= self._next_report:
            if not self.silent:
                self.log.warn('silent', 'no valid frame for %g s; the status says so until '
                              'the board talks again' % self._timeout)
            self.silent = True
            self._next_report = max(self._next_report + _STATUS_PERIOD, now)
            if self._on_silence:
                self._on_silence(self._kinds, self._last_seq, now - self._alive_at)
        return self._next_report

    def idle(self, now: float) -> None:
        self.tick(now)

    def condition(self, now: float) -> Tuple[int, str]:
        if not self.port.is_open:
            return super().condition(now)
        return (WARN, 'open, the board is silent') if self.silent else (OK, 'open')

    def own_values(self) -> List[Tuple[str, Any]]:
        return [('frames lost', self.frames_lost), ('frames doubled', self.duplicates)]
