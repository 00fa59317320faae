"""The outcome of a call, as a value and as a text that contains the status.

Most service responses have a field for the status. If the type has none, the status is put in the
text, in a form that only this module writes and reads:

    status 254 (not known): no reply within 0.5 s: it is not known whether this was executed; …
"""
import enum
import re
from typing import Any, NamedTuple, Optional, Tuple

# A status is the CMD1 of a reply on the bus, or one of the two that the bridge adds.
_DONE = (0x00, 0x01, 0x02)      # SYNC, ECHO, OK
_ERROR, _INVALID = 0x03, 0xFF
NOT_SENT = 253     # refused by the bridge: nothing was sent
TIMEOUT = 254      # not known: executed once or not at all, unless it may be repeated
LOOK = 'check the robot before you repeat it'   # advice where the outcome is not known

STOPPED = 'stopped: call ~stop with data: false'     # why a command is refused meanwhile

_NAMES = {_ERROR: 'ERROR', _INVALID: 'INVALID', NOT_SENT: 'not sent', TIMEOUT: 'not known'}
# A program that passes such a text on may put words and a colon before it.
_TEXT = re.compile(r'(?:^|: )status (\d{1,3}) \([^)]*\): (.*)', re.DOTALL)


class Refused(Exception):
    """A command was not sent; the text says why."""

    def __init__(self, text: str, cause: str) -> None:
        super().__init__(text)
        self.cause = cause      # in a word or two; lines with the same one are logged sparingly


class Verdict(enum.Enum):
    """Whether a call was executed."""

    DONE = 'done'              # executed; exactly once, unless it may be repeated
    REFUSED = 'refused'        # not executed
    NOT_KNOWN = 'not known'    # executed once or not at all, unless it may be repeated


class Outcome(NamedTuple):
    """The outcome of a call, as it is returned to the caller."""

    status: int              # the reply's CMD1, NOT_SENT or TIMEOUT
    message: str             # for people
    error_code: int = 0
    data: bytes = b''        # of the reply
    round_trip: float = 0.0  # s
    as_expected: bool = True   # whether `data` has a valid length and plausible values
    stamp: Any = None        # of the read that had the reply's last byte

    @property
    def success(self) -> bool:
        """Whether it was executed, as `Verdict.DONE`, with a reply as expected."""
        return self.status in _DONE and self.as_expected

    @property
    def text(self) -> str:
        """The status and the message, for responses without a field for the status."""
        name = _NAMES.get(self.status, 'answered, but not as expected')
        return f'status {self.status} ({name}): {self.message}'


def read_text(text: str) -> Tuple[Optional[int], str]:
    """The status and the message in `Outcome.text`; None and `text` itself for any other text."""
    found = _TEXT.search(text)
    return (int(found.group(1)), found.group(2)) if found else (None, text)


def verdict_of_failure(status: Optional[int]) -> Verdict:
    """The verdict on a call that was reported as failed; `status` None: it was not reported."""
    refused = status in (NOT_SENT, _ERROR, _INVALID)
    return Verdict.REFUSED if refused else Verdict.NOT_KNOWN
