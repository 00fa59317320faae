"""Says in the log that a board talks, has fallen silent and is back: each once, when it changes."""
from typing import Dict, Optional

from .sparing_log import SparingLog

FIRST_WORD = 3.0      # s after the port opened in which a board is to say something
LOOK_PERIOD = 0.5     # s from one look at it to the next
_PERIOD = 10.0        # s from one line to the next that says the same


class Presence:
    """What was said of a board last. A change that was said not long ago is said again later, if
    it still holds."""

    def __init__(self, log: SparingLog) -> None:
        self._log = log
        self._said: Optional[bool] = None
        self._silent_since = 0.0
        self._has_talked = False
        self._said_at: Dict[str, float] = {}

    def see(self, talks: Optional[bool], silence: str, now: float) -> None:
        """To be told every `LOOK_PERIOD` seconds whether it talks; None where nobody can tell.

        Args:
            silence: how its silence is to be told.
            now: monotonic.
        """
        word = 'silent' if not talks else 'back' if self._has_talked else 'ready'
        if talks is None or talks is self._said \
                or now < self._said_at.get(word, now - _PERIOD) + _PERIOD:
            return
        self._said_at[word] = now
        if word == 'silent':
            self._silent_since = now
            self._log.always_warn(silence)
        elif word == 'back':
            self._log.always_info(f'the board is back, after {now - self._silent_since:.3g} s')
        else:
            self._log.always_info('ready: the board talks')
        self._has_talked = self._has_talked or talks
        self._said = talks
