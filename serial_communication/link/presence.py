"""Whether a board talks, and what is received instead; each change is logged."""
import re
from typing import Dict, Optional

from ..framing.layout import readable
from ..framing.stream import FRAMING, OVERSIZE, UNKNOWN, Frame
from .sparing_log import SparingLog

SILENCE = 1.0         # s without a frame after which a board counts as silent
STARTUP_TIME = 3.0    # s after the port opened in which a board may still start up silently
_LOOK_PERIOD = 0.5    # s from one `log` to the next
_PERIOD = 10.0        # s; the same line is not repeated sooner
_NO_FRAME_TIME = 5.0  # s in which bytes come, but no valid frame
_PAUSE = 3.0          # s without a byte after which the bytes before no longer count
_NEVER = float('-inf')
_NO_FRAME = ('no valid frame: wrong baud rate or board? end the bridge and run '
             '`rosrun serial_communication ports`')
_UNKNOWN_TYPES = ('messages come, but of unknown types: no row of the parameters, and none that '
                  'the board announces, has them')
# What Serial.println and printf send, at the beginning of an invalid frame; long enough that noise
# hardly ever looks like it.
_CHARACTER = rb'(?:[\t -~]|[\xc2-\xf4][\x80-\xbf]{1,3})'
_TEXT = re.compile(b'C+\r\n|C{8,}\n|C{24,}'.replace(b'C', _CHARACTER))


class Presence:
    """What one link receives. Times are monotonic.

    Args:
        print_to: what a sketch should print to instead of the port.
    """

    def __init__(self, log: SparingLog, print_to: str) -> None:
        self.due = _NEVER              # when to call `log` next
        self.understood_at = _NEVER    # the latest frame of a known type
        self._log = log
        self._prints = f'the sketch prints text to this port: use {print_to}'
        self._state = ''               # that was logged last
        self._has_talked = False
        self._silent_since = 0.0
        self._logged_at: Dict[str, float] = {}
        self.opened()

    def opened(self) -> None:
        self._may_be_cut = True     # the next invalid frame may have begun before
        self._byte_at = self._began_at = self._printed_at = _NEVER
        self._surplus = 0           # bytes of unknown types, less those of invalid frames

    def bytes_came(self, now: float) -> None:
        if now > self._byte_at + _PAUSE:
            self._began_at, self._surplus = now, 0
        self._byte_at = now

    def understood(self, now: float) -> None:
        """A frame of a known type was received."""
        self.understood_at, self._surplus = now, 0

    def not_understood(self, frame: Frame, now: float) -> str:
        """Another frame was received; return a line that quotes it if it is printed text."""
        if frame.cause in ('', UNKNOWN):
            self._surplus += len(frame.raw)
            return ''
        self._surplus -= len(frame.raw)
        text = frame.cause in (FRAMING, OVERSIZE) and not self._may_be_cut \
            and _TEXT.match(frame.raw)
        self._may_be_cut = False
        if not text:
            return ''
        self._printed_at = now
        return f'{self._prints}: {readable(text.group()[:60].decode("utf-8", "replace"))!r}'

    def printed(self, now: float) -> str:
        """That the board prints text, for people; '' if it does not now."""
        return self._prints if now <= self._printed_at + _PAUSE else ''

    def meaning(self, now: float) -> str:
        """What comes instead of the board's messages, for people; '' if that is not known."""
        if self.printed(now) or now > self._byte_at + _PAUSE:
            return self.printed(now)
        if now < max(self._began_at, self.understood_at) + _NO_FRAME_TIME:
            return ''
        return _UNKNOWN_TYPES if self._surplus > 0 else _NO_FRAME

    def log(self, talks: Optional[bool], silence: str, now: float) -> None:
        """Log a change; to be called when it is `due`. A line that was logged less than 10 s ago
        waits until then, and is left out if it no longer holds.

        Args:
            talks: whether the board talks; None: unknown.
            silence: the line for a board that sends nothing.
        """
        self.due = now + _LOOK_PERIOD
        meaning = self.meaning(now)
        may_follow = not talks and not meaning and \
            self.understood_at + SILENCE < now <= self._byte_at + SILENCE
        state = 'talks' if talks else meaning or silence
        line = 'back' if talks and self._has_talked else state
        if talks is None or may_follow or state == self._state \
                or now < self._logged_at.get(line, _NEVER) + _PERIOD:
            return
        if self._state in ('', 'talks'):
            self._silent_since = now
        self._state, self._logged_at[line] = state, now
        if not talks:
            self._log.always_warn(state)
        elif self._has_talked:
            self._log.always_info('the board is back, it was silent for '
                                  f'{now - self._silent_since:.3g} s')
        else:
            self._log.always_info('ready: the board talks')
        self._has_talked = self._has_talked or talks
