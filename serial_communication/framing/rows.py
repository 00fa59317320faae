"""Rows: the messages, commands, functions and settings of a board, built in or not.

`row_reader` reads those of parameters and announcements. ROS types and topics stay text here; `ros`
resolves them.
"""
import enum
import struct
from contextlib import suppress
from dataclasses import dataclass, field
from math import inf, isfinite
from typing import Any, Dict, Iterable, Optional, Sequence, Tuple

from .layout import EMPTY, FRACTIONS, Layout, Value, brief, message_class, readable, shortest
from .stream import SETTING

BUILT_IN, FILE, BOARD = 'built in', 'file', 'board'      # where a row is from


class Kind(enum.Enum):
    """What a row is."""

    FROM = 'from_board'      # a message of the board: a topic
    TO = 'to_board'          # a command: a subscription
    FUNCTION = 'function'    # a request with a reply: a service, or a topic that is polled
    SETTING = 'setting'      # a number of the firmware that changes while it runs


_NUMBERS = {Kind.FROM: 'type', Kind.TO: 'type', Kind.FUNCTION: 'cmd2', Kind.SETTING: 'setting'}


class RowError(ValueError):
    """A row that cannot be used; the text is one line.

    Args:
        key: the parameter, as ``arduino/messages/force/layout``.
        value: its value; None: it is missing.
        allowed: what it may be, in words.
    """

    def __init__(self, key: str, value: Any, allowed: str) -> None:
        is_what = 'is missing' if value is None else \
            f'is {brief(value, 120)} ({type(value).__name__})'
        super().__init__(readable(f'{key} {is_what}, {allowed}'))
        self.key = key


@dataclass(frozen=True)
class Row:
    """One row. Two are equal if they mean the same, wherever they are from."""

    name: str
    number: int = 0               # on the wire: message type, CMD2, or number of the setting
    kind: Kind = Kind.FROM
    layout: Layout = EMPTY        # of its data; a function's: of the request. Names are ROS paths
    reply: Layout = EMPTY         # of a function's reply
    ros_type: str = ''            # of the topic; of the service, where there is no period
    period: float = 0.0           # s between two messages, or two polls; 0: not known, not polled
    frame_id: str = ''
    child_frame_id: str = ''      # the frame whose pose the message has
    constants: Dict[str, Any] = field(default_factory=dict)    # values by path
    timeout: Optional[float] = None     # of a function, s; None: the board's
    repeatable: bool = False      # a function that may be sent again if its outcome is not known
    interrupts: bool = False      # a function that stops: sent at once, whatever is outstanding
    motion: bool = False          # a command that moves something: see doc/rows.md
    newest: bool = False          # of the commands that wait, only the newest counts
    unit: str = ''                # of a setting
    description: str = ''
    message: Any = field(default=None, compare=False)     # class of a message or command
    origin: str = field(default=BUILT_IN, compare=False)
    key: str = field(default='', compare=False)     # its parameter: arduino/messages/force

    @property
    def announced(self) -> bool:
        """Whether the board announced it, so it holds only until the board may be another one."""
        return self.origin == BOARD

    @property
    def number_key(self) -> str:
        """The key of its number in a row."""
        return _NUMBERS[self.kind]

    @property
    def zero(self) -> Any:
        """The message of a motion with which nothing moves."""
        return self.message(*[0] * len(self.layout.values))

    def saturated(self, values: Sequence) -> Tuple[Sequence, str]:
        """What is sent of the values of a motion, and why it differs from them; '' if it does not.

        A value beyond a limit is the limit; with one that is not finite, all are 0.
        """
        sent, why = list(values), ''
        for index, (given, value) in enumerate(zip(values, self.layout.values)):
            if not value.name or value.code == '?':
                continue
            if not isfinite(given):
                return [0] * len(sent), f'{self.name}: {value.name} is {given}, sent 0'
            (least, most), (low, high) = value.range, value.limits
            if not max(low, least) <= given <= min(high, most):
                sent[index] = min(max(given, value.minimum, least), value.maximum, most)
                why = (f'{self.name}: {value.name} is {given:.6g}, out of range, '
                       f'sent {sent[index]:.6g}')
        return sent, why


@dataclass(frozen=True)
class Setting(Row):
    """A setting; its layout has the number and the value."""

    kind: Kind = Kind.SETTING
    minimum: float = -inf
    maximum: float = inf

    @property
    def code(self) -> str:
        """Struct's code of the value."""
        return self.layout.values[1].code

    @property
    def default(self) -> Any:
        """The allowed value that is nearest to 0, in place of one that is not known."""
        return self.checked(min(max(0, self.minimum), self.maximum))

    def _allowed(self) -> str:
        if self.code == '?':
            return 'may be true or false'
        kind = 'number' if self.code in FRACTIONS else 'whole number'
        least, most = self.layout.values[1].range
        low = '' if self.minimum == least else f' from {self.minimum:.10g}'
        high = '' if self.maximum == most else f' to {self.maximum:.10g}'
        return f'may be a {kind}{low}{high} {self.unit}'.rstrip()

    def checked(self, value: Any) -> Any:
        """The value as the board will have it; ValueError, with what is allowed, if it is not."""
        is_float = self.code in FRACTIONS
        with suppress(struct.error, OverflowError):     # its place cannot hold it
            if type(value) in (bool, int, float) and self.minimum <= (
                    shortest(value) if is_float else value) <= self.maximum:
                value = self.layout.unpack(self.layout.pack((self.number, value)))[1]
                return shortest(value) if is_float else value
        raise ValueError(self._allowed())


def refuse_second_number(row: Row, others: Iterable[Row]) -> None:
    """Raise RowError if another row has the number of this one."""
    for other in others:
        if (row.number_key, row.number) == (other.number_key, other.number):
            raise RowError(f'{row.key}/{row.number_key}', row.number,
                           f'is already the {row.number_key} of {other.name}')


# One without a row. Us -> board: use this value; board -> us: it is in use.
SettingMessage = message_class(
    'SettingMessage', SETTING, '<BB*', [Value('number'), Value('value')], 'setting')
