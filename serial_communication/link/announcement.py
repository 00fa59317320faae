"""What a board announces, and which of it may be used now."""
from typing import Any, Callable, List, Optional

from ..framing.announcement import Assembly, Chunk
from .sparing_log import SparingLog

_BEGINS, _ENDS = 5.0, 20.0     # s after the opening: by then an announcement has begun, has ended


class BoardAnnouncement:
    """The announcement of one board, as far as its link knows it.

    After the port was opened the board may be another one, or have other firmware. So until the
    board has announced the rows again, nothing that they describe is sent or published.
    """

    def __init__(self, log: SparingLog) -> None:
        # Called in the link's thread with each new text; None: announcements are ignored.
        self.on_text: Optional[Callable[[bytes], None]] = None
        self.firmware = ''                       # NAME VERSION; '' if the board announces none
        self.rows: Optional[List[str]] = None    # names of those in use; None: nothing announced
        self.held_back = 0                       # values of announced rows: see `holds_back`
        self.assembly = Assembly()
        self._in_use: Optional[bytes] = None     # the text whose rows are in use
        self._log = log

    def add(self, chunk: Chunk) -> None:
        """A chunk was received; called in the link's thread."""
        if self.on_text:
            text = self.assembly.add(chunk)
            if text is not None:
                self.on_text(text)

    def use(self, text: bytes, firmware: str, rows: List[str]) -> None:
        """The rows of this text are in use from now on; any thread may call this."""
        self.firmware, self.rows, self._in_use = firmware, rows, text

    def may_announce(self, age: float) -> bool:
        """Whether the board may yet announce a type that is unknown `age` s after the opening."""
        limit = _ENDS if self.assembly.begun and not self.is_current else _BEGINS
        return self.on_text is not None and age < limit

    @property
    def is_current(self) -> bool:
        """Whether the board is known to announce the rows in use."""
        return self.assembly.confirmed and self.assembly.text == self._in_use

    def holds_back(self, message: Any) -> bool:
        """Whether a received message must not be published, since the board is not known to
        announce its row; it is then counted."""
        if not message.ANNOUNCED or self.is_current:
            return False
        self.held_back += 1
        return True
