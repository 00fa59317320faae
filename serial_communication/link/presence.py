"""Whether a board talks; each change is logged."""
from typing import Optional

from .sparing_log import SparingLog

SILENCE = 1.0         # s without a frame after which a board counts as silent
_STARTUP_TIME = 3.0   # s after the port opened in which a board may still start up silently
_NO_FRAME_TIME = 5.0  # s in which bytes come, but no valid frame
_NO_FRAME = ('no valid frame: wrong baud rate or board? end the bridge and run '
             '`rosrun serial_communication ports`')
_SILENT = 'the board is silent; check its power, its wiring and the baud rate ({})'
_TALKS = 'ready: the board talks'


class Presence:
    """What one link hears. Times are monotonic, in s."""

    def __init__(self, log: SparingLog) -> None:
        self.opened_at = 0.0
        self.byte_at = 0.0          # the opening counts as a byte
        self.frame_at: Optional[float] = None      # the latest valid frame; None: none yet
        self._log = log
        self._state = ''            # that was logged last

    def opened(self, now: float) -> None:
        self.opened_at = self.byte_at = now

    def heard(self, now: float) -> None:
        """A valid frame was received."""
        self.frame_at = now

    def talks(self, now: float) -> bool:
        return self.frame_at is not None and now - self.frame_at <= SILENCE

    def no_frame(self, now: float) -> str:
        """That bytes come without a valid frame, for people; '' if not."""
        return _NO_FRAME if self.byte_at > max(
            now - SILENCE, max(self.opened_at, self.frame_at or 0.0) + _NO_FRAME_TIME) else ''

    def check(self, talks: Optional[bool], baud: int, now: float) -> None:
        """Log a change; `talks` None: unknown."""
        state = _TALKS if talks else self.no_frame(now) or _SILENT.format(baud)
        comes = self.byte_at > max(now - SILENCE, self.opened_at)      # wait for what that is
        if talks is None or state == self._state or not talks and (
                now < self.opened_at + _STARTUP_TIME or comes and not self.no_frame(now)):
            return
        if talks:
            self._log.info('talks', state)
        else:
            self._log.warn('silent', state)
        self._state = state
