"""What became of a call: as a value, and as a text that carries the value.

A service's response has a field for the status. Where its type has none, the status stands in a
text, in a fixed form that is made and read only here:

    status 254 (not known): no reply within 0.5 s: it is not known whether this was executed; …
"""
import enum
import re
from typing import Any, NamedTuple, Optional, Tuple


# The numbers are those of the replies on the bus, and two of our own.
_DONE = (0x00, 0x01, 0x02)      # SYNC, ECHO, OK
_ERROR, _INVALID = 0x03, 0xFF
NOT_SENT = 253     # refused here: nothing left the port
TIMEOUT = 254      # the outcome is unknown: executed once or not at all
LOOK = 'look before you repeat it'

_NAMES = {_ERROR: 'ERROR', _INVALID: 'INVALID', NOT_SENT: 'not sent', TIMEOUT: 'not known'}
# Whoever passes such a text on may put words and a colon before it.
_TEXT = re.compile(r'(?:^|: )status (\d{1,3}) \([^)]*\): (.*)', re.DOTALL)


class Verdict(enum.Enum):
    """What a caller has to know first."""

    DONE = 'done'              # executed, exactly once
    REFUSED = 'refused'        # not executed
    NOT_KNOWN = 'not known'    # executed or not: look before you repeat it


class Outcome(NamedTuple):
    """What became of a call, as it is returned to the caller."""

    status: int              # the reply's CMD1, NOT_SENT or TIMEOUT
    message: str             # for a person
    error_code: int = 0
    data: bytes = b''
    round_trip: float = 0.0  # s
    as_expected: bool = True   # whether `data` has the length and the values that it may have
    stamp: Any = None        # of the read that brought the reply

    @property
    def success(self) -> bool:
        """Executed, exactly once, and answered as expected."""
        return self.status in _DONE and self.as_expected

    @property
    def text(self) -> str:
        """The message behind the status, for where only a text can be returned."""
        name = _NAMES.get(self.status, 'answered, but not as expected')
        return f'status {self.status} ({name}): {self.message}'


def read_text(text: str) -> Tuple[Optional[int], str]:
    """The status and the message in the text of an outcome; None and `text` if it is none."""
    found = _TEXT.search(text)
    return (int(found.group(1)), found.group(2)) if found else (None, text)


def verdict_of_failure(status: Optional[int]) -> Verdict:
    """What a status means of a call that was not reported as a success; None: not told."""
    refused = status in (NOT_SENT, _ERROR, _INVALID)
    return Verdict.REFUSED if refused else Verdict.NOT_KNOWN
