"""Custom messages that simulated boards send, and values for replies to custom functions.

Values oscillate between their minimum and maximum, or between -100 and 100 without limits.
"""
import argparse
import math
from typing import Any, Iterable, List, Optional, Tuple

from ..boards.config_file import board_parameters, read_parameters
from ..boards.description import Description
from ..framing.custom_messages import CustomMessage
from ..framing.layout import Layout, Value
from ..transport.pace import Every

PERIOD = 0.1      # s between two messages of a kind
_UNLIMITED = 100.0     # the maximum of a value that has none
_OSCILLATION = 10.0    # s; period of a value


def add_option(parser: argparse.ArgumentParser, board: Description) -> None:
    """Add the option --config FILE, whose value is the list of the board's custom messages."""
    if board.custom is None:
        # Accepted, since a launch file passes it to all boards.
        parser.add_argument('--config', metavar='FILE',
                            help='parameters of the bridge; not used by this board')
        return
    parameter, read_rows, _ = board.custom

    def read(path: str) -> List[Any]:
        try:
            given = board_parameters(read_parameters(path), board.name)
            return read_rows(given.get(parameter) or {})
        except (OSError, ValueError) as error:
            raise argparse.ArgumentTypeError(f'{path}: {error}') from None

    parser.add_argument('--config', type=read, default=[], metavar='FILE',
                        help='parameters of the bridge; the board has the custom messages in '
                             f'{board.name}/{parameter}')


class CustomMessagePlayer:
    """Makes the custom messages that a board sends, one of each kind every `PERIOD` s.

    Args:
        messages: commands among them are ignored.
    """

    def __init__(self, messages: Iterable[CustomMessage]) -> None:
        self._kinds = [custom.kind for custom in messages if not custom.is_command]
        self._beat = Every(PERIOD, 0.0)

    def power_on(self, now: float) -> None:
        """The board starts."""
        self._beat = Every(PERIOD, now)

    def due(self) -> Optional[float]:
        """When the next messages are due; None: never."""
        return self._beat.due if self._kinds else None

    def messages(self, now: float) -> List[Any]:
        """The messages to send now."""
        if not self._kinds or not self._beat.passed(now):
            return []
        return [kind(*simulated_values(kind.LAYOUT, now)) for kind in self._kinds]


def simulated_values(layout: Layout, now: float) -> Tuple:
    """Values within their limits, which depend on the time; an array has 4 numbers."""
    return tuple(_text(value, now) if value.kind == 'text'
                 else _number(value, index, now) if value.kind == 'number'
                 else tuple(_number(value, index, now + element) for element in range(4))
                 for index, value in enumerate(layout.values))


def _number(value: Value, index: int, now: float) -> float:
    least, most = value.range
    low, high = value.minimum, value.maximum
    if math.isinf(low):
        low = min(high, _UNLIMITED) - 2 * _UNLIMITED
    if math.isinf(high):
        high = max(low, -_UNLIMITED) + 2 * _UNLIMITED
    low, high = max(low, least), min(high, most)
    phase = 2 * math.pi * now / _OSCILLATION + index
    number = low + (high - low) * (0.5 + 0.49 * math.sin(phase))
    if value.may_be_nan:
        return number
    # Round to a raw number within the limits.
    ends = sorted(((low - value.offset) / value.scale, (high - value.offset) / value.scale))
    raw = min(max(round((number - value.offset) / value.scale), math.ceil(ends[0] - 1e-9)),
              math.floor(ends[1] + 1e-9))
    return value.scaled(raw)


def _text(value: Value, now: float) -> str:
    return f'simulated {now:.0f}'[:value.room]
