"""Says in the log that a board talks, has fallen silent and is back: each once, when it changes."""
from typing import Optional

from ..transport.pace import Allowance
from .sparing_log import SparingLog

FIRST_WORD = 3.0      # s after the port opened in which a board is to say something
LOOK_PERIOD = 0.5     # s from one look at it to the next
_LINES = 4, 0.1       # in a burst, and a second after that


class Presence:
    """What was said of a board last. A change that comes too soon after others is said later, if
    it still holds: the last line is always true."""

    def __init__(self, log: SparingLog) -> None:
        self._log = log
        self._said: Optional[bool] = None
        self._silent_since = 0.0
        self._has_talked = False
        self._lines = Allowance(*_LINES)

    def see(self, talks: Optional[bool], silence: str, now: float) -> None:
        """To be told every `LOOK_PERIOD` seconds whether it talks; None where nobody can tell.

        Args:
            silence: how its silence is to be told.
            now: monotonic.
        """
        if talks is None or talks is self._said or not self._lines.take(now):
            return
        if not talks:
            self._silent_since = now
            self._log.always_warn(silence)
        elif self._has_talked:
            self._log.always_info(f'the board is back, after {now - self._silent_since:.3g} s')
        else:
            self._log.always_info('ready: the board talks')
        self._has_talked = self._has_talked or talks
        self._said = talks
