"""What crosses a port: counted, and passed to a listener."""
import traceback
from collections import Counter
from typing import Callable, Dict, Iterable, Optional

from ..framing.stream import Frame
from .sparing_log import SparingLog

RX, TX = 0, 1                  # as in SerialMsg

Tap = Callable[[str, int, Frame], None]      # gets the link's name, RX or TX, and the frame


class Traffic:
    """The traffic of one link.

    Args:
        causes: of errors, which are shown although there are none.
    """

    def __init__(self, name: str, log: SparingLog, causes: Iterable[str]) -> None:
        self.tap: Optional[Tap] = None     # called with every frame in and out; None: no listener
        self.frames_received = 0           # valid ones
        self.frames_sent = 0
        self.stale = 0                     # bytes dropped because they may be old
        self.reported_errors = 0           # those until the latest report
        self.errors: Dict[str, int] = Counter(dict.fromkeys(causes, 0))     # by cause
        self._name, self._log = name, log

    def tapped(self, direction: int, frame: Frame) -> None:
        """Pass a frame to the listener."""
        tap = self.tap      # another thread may set it to None meanwhile
        try:
            if tap:
                tap(self._name, direction, frame)
        except Exception:  # pylint: disable=broad-except
            # Guarded: an error here would look as if the frame had not been sent.
            self._log.error('fault', traceback.format_exc())
