"""Custom messages and settings of simulated boards, and values for replies to functions.

Values oscillate between their minimum and maximum, or between -100 and 100 without limits. One
that may be "no value" is that for one second in ten.
"""
import argparse
import math
from typing import Any, Dict, Iterable, List, Mapping, Optional, Sequence, Tuple

from .arguments import board_parameters, read_parameters
from ..boards.description import Description
from ..framing.layout import BOARD_TIME, FRACTIONS, NO_VALUE, Layout, Value
from ..framing.rows import Kind, Row, Setting
from ..transport.pace import Every
from .announcing import chunks_of, write_announcement

PERIOD = 0.1      # s between two messages of a kind
CHUNK = 60        # bytes of text in a chunk of an announcement
_OFTEN, _SELDOM = 0.1, 1.0     # s between two chunks: at first, later
_LEAST_OFTEN = 30      # chunks; so many are sent often at least, each of them twice at least
_UNLIMITED = 100.0     # the maximum of a value that has none
_OSCILLATION = 10.0    # s; period of a value
_NO_VALUE_FOR = 1.0    # s of each period


class Configured(list):
    """The rows of a board in a configuration, without its settings, which are in `settings`.

    Args:
        parameters: the board's.

    Raises:
        RowError: the rate of the port, or a row, is wrong.
    """

    def __init__(self, board: Description, parameters: Mapping[str, Any]) -> None:
        self.baud = board.baud_of(parameters)
        rows = board.read_all(parameters)
        super().__init__(row for row in rows if row.kind is not Kind.SETTING)
        self.settings = [row for row in rows if row.kind is Kind.SETTING]
        self.given: Dict[str, Any] = {}      # that the board announces
        for group in board.groups:
            self.given.update(parameters.get(group.parameter) or {})


def add_options(parser: argparse.ArgumentParser, board: Description) -> None:
    """Add the options --config FILE, whose value is a `Configured`, and --announce."""
    def read(path: str) -> Configured:
        try:
            return Configured(board, board_parameters(read_parameters(path), board.name))
        except (OSError, ValueError) as error:
            raise argparse.ArgumentTypeError(f'{path}: {error}') from None

    rows = f'; the board has the custom messages in {board.name}/{board.groups[0].parameter}' \
        if board.groups else ''
    parser.add_argument('--config', type=read, default=Configured(board, {}), metavar='FILE',
                        help=f"parameters of the bridge, for the port's rate{rows}")
    if board.groups:
        parser.add_argument('--announce', action='store_true',
                            help='announce them to the bridge, which then needs no such file')


def announced_text(board: str, config: Configured) -> bytes:
    """The text with which a simulated board announces the rows of its configuration.

    Raises:
        ValueError: the rows cannot be announced.
    """
    return write_announcement(config.given, f'simulated_{board} 1.0')


class CustomMessagePlayer:
    """Makes the custom messages that a board sends, one of each kind every `PERIOD` s. Also makes
    the chunks of its announcement and the reports of its settings, in turn: one of each every 0.1 s
    until each has been sent twice, and for at least 3 s; later one of each a second.

    Args:
        messages: commands among them are ignored.
        announcement: the text; None: the board announces nothing.
        settings: that the board has.
    """

    def __init__(self, messages: Iterable[Row], announcement: Optional[bytes] = None,
                 settings: Sequence[Setting] = ()) -> None:
        self.settings: Dict[int, Any] = {}      # their values, by number
        self._rows = {row.number: row for row in settings}
        self._kinds = [row.message for row in messages if row.kind is Kind.FROM]
        self._beat = Every(PERIOD, 0.0)
        self._chunks = [] if announcement is None else chunks_of(announcement, CHUNK)
        self._next = 0             # index of the next chunk
        self._turn: List[int] = []     # numbers of the settings, that of the next report first
        self._chunk_due = 0.0
        self._often = 0            # so many more chunks are sent often

    def power_on(self, now: float) -> None:
        """The board starts."""
        self._beat = Every(PERIOD, now)
        self._next = 0
        self._chunk_due = now
        self.settings = {number: row.default for number, row in self._rows.items()}
        self._turn = sorted(self._rows)
        self.announce_often(now)

    def announce_often(self, now: float) -> None:
        """Somebody may listen anew: send the chunks more often for a while."""
        self._chunk_due = min(self._chunk_due, now + _OFTEN)
        self._often = max(_LEAST_OFTEN, 2 * len(self._chunks), 2 * len(self._rows))

    def due(self) -> Optional[float]:
        """When the next messages are due; None: never."""
        times = [self._beat.due] * bool(self._kinds) + [self._chunk_due] * bool(
            self._chunks or self._rows)
        return min(times, default=None)

    def messages(self, now: float, micros: int) -> List[Any]:
        """The messages to send now, when the board's clock is at `micros`."""
        if not (self._kinds and self._beat.passed(now)):
            return []
        return [kind(*simulated_values(kind.LAYOUT, now, micros)) for kind in self._kinds]

    def announcements(self, now: float) -> List[Any]:
        """The chunk and the report of a setting to send now, if there are such."""
        if now < self._chunk_due:
            return []
        found: List[Any] = []
        if self._turn:
            found.append(self._report(self._turn[0]))
            self._turn.append(self._turn.pop(0))
        if self._chunks:
            found.append(self._chunks[self._next])
            self._next = (self._next + 1) % len(self._chunks)
        self._often = max(0, self._often - 1)
        self._chunk_due = now + (_OFTEN if self._often else _SELDOM)
        return found

    def use(self, message: Any) -> List[Any]:
        """Use the value of a setting, within its limits; return the board's answer."""
        row = self._rows.get(message[0])
        if row is None:
            return []
        self.settings[row.number] = row.checked(min(max(message[1], row.minimum), row.maximum))
        return [self._report(row.number)]

    def _report(self, number: int) -> Any:
        return self._rows[number].message(number, self.settings[number])


def simulated_values(layout: Layout, now: float, micros: int = 0) -> Tuple:
    """Values within their limits, which depend on the time; an array has 4 numbers."""
    return tuple(micros if value.name == BOARD_TIME
                 else _text(value, now) if value.kind == 'text'
                 else _number(value, index, now) if value.kind == 'number'
                 else tuple(_number(value, index, now + element) for element in range(4))
                 for index, value in enumerate(layout.values))


def _number(value: Value, index: int, now: float) -> float:
    if value.invalid is not None and now % _OSCILLATION < _NO_VALUE_FOR:
        return NO_VALUE
    least, most = value.range
    low, high = value.minimum, value.maximum
    if math.isinf(low):
        low = min(high, _UNLIMITED) - 2 * _UNLIMITED
    if math.isinf(high):
        high = max(low, -_UNLIMITED) + 2 * _UNLIMITED
    low, high = max(low, least), min(high, most)
    phase = 2 * math.pi * now / _OSCILLATION + index
    number = low + (high - low) * (0.5 + 0.49 * math.sin(phase))
    if value.code in FRACTIONS:
        return number
    # Round to a raw number within the limits.
    ends = sorted(((low - value.offset) / value.scale, (high - value.offset) / value.scale))
    raw = min(max(round((number - value.offset) / value.scale), math.ceil(ends[0] - 1e-9)),
              math.floor(ends[1] + 1e-9))
    return value.scaled(raw)


def _text(value: Value, now: float) -> str:
    return f'simulated {now:.0f}'[:value.end - value.start if value.end > 0 else None]
