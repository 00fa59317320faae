"""Logs when a board begins to talk, falls silent and is back."""
from typing import Dict, Optional

from .sparing_log import SparingLog

SILENCE = 1.0         # s without a frame after which a board counts as silent
STARTUP_TIME = 3.0    # s after the port opened in which a board may still start up silently
LOOK_PERIOD = 0.5     # s from one `update` to the next
_PERIOD = 10.0        # s; the same line is not repeated sooner


class PresenceLog:
    """Logs each change once, also of the reason for a silence. If the same line was logged less
    than 10 s ago, it waits until then, and is left out if it no longer holds."""

    def __init__(self, log: SparingLog) -> None:
        self.due = float('-inf')     # when to call `update` next; monotonic
        self._log = log
        self._logged = ''      # the state that the latest line reports
        self._silent_since = 0.0
        self._has_talked = False
        self._logged_at: Dict[str, float] = {}

    def update(self, talks: Optional[bool], silence: str, now: float) -> None:
        """To be called when it is `due`: whether the board talks (None: unknown), and the line that
        reports its silence."""
        self.due = now + LOOK_PERIOD
        state = 'talks' if talks else silence
        line = silence if not talks else 'back' if self._has_talked else 'ready'
        if talks is None or state == self._logged \
                or now < self._logged_at.get(line, now - _PERIOD) + _PERIOD:
            return
        self._logged_at = {each: at for each, at in self._logged_at.items() if now < at + _PERIOD}
        self._logged_at[line] = now
        if not talks:
            if self._logged in ('', 'talks'):
                self._silent_since = now
            self._log.always_warn(silence)
        elif self._has_talked:
            self._log.always_info('the board is back, it was silent for '
                                  f'{now - self._silent_since:.3g} s')
        else:
            self._log.always_info('ready: the board talks')
        self._has_talked = self._has_talked or talks
        self._logged = state
