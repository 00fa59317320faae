"""The outcome of a call: a value, until it reaches a response."""
from typing import Any, NamedTuple

# A status is the CMD1 of a reply on the bus, or one of the two that the bridge adds.
_DONE = (0x00, 0x01, 0x02)      # SYNC, ECHO, OK
NOT_SENT = 253     # refused by the bridge: nothing was sent
TIMEOUT = 254      # not known: executed once or not at all, unless it may be repeated
LOOK = 'check the robot before you repeat it'   # advice where the outcome is not known

# Why a command is refused.
STOPPED = 'stopped: call ~stop with data: false'
NOT_ANNOUNCED = 'the board may have begun anew, and has not announced this since'


class Refused(Exception):
    """A command was not sent; the text says why."""

    def __init__(self, text: str, cause: str) -> None:
        super().__init__(text)
        self.cause = cause      # in a word or two; lines with the same one are logged sparingly


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
        """Whether it was executed, with a reply as expected."""
        return self.status in _DONE and self.as_expected
