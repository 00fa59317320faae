"""Custom messages and functions, as simulated boards play and answer them.

Values wander between their minimum and maximum, or between -100 and 100 where they have none.
"""
import argparse
import math
from typing import Any, Iterable, List, Optional, Tuple

from ..boards.config_file import of_board, read_parameters
from ..boards.description import Description
from ..framing.custom_messages import CustomMessage
from ..framing.layout import Layout, Value
from ..transport.pace import Every

PERIOD = 0.1      # s from one message of a kind to the next
_UNLIMITED = 100.0
_TURN = 10.0      # s in which a value comes round


def add_option(parser: argparse.ArgumentParser, board: Description) -> None:
    """--config FILE, in which the board's custom messages are read."""
    custom = board.custom
    if custom is None:
        # Taken for what a launch file gives to all of them.
        parser.add_argument('--config', metavar='FILE',
                            help='parameters of the bridge; this board needs none of them')
        return

    def read(path: str) -> List[Any]:
        try:
            return custom.read(of_board(read_parameters(path), board.name).get(custom.parameter)
                               or {})
        except (OSError, ValueError) as error:
            raise argparse.ArgumentTypeError(f'{path}: {error}') from None

    parser.add_argument('--config', type=read, default=[], metavar='FILE',
                        help=f'parameters of the bridge: its {board.name}/{custom.parameter}, '
                             'too, are played')


class Player:
    """Which custom messages a board sends when.

    Args:
        messages: commands among them are left out.
    """

    def __init__(self, messages: Iterable[CustomMessage]) -> None:
        self._kinds = [own.kind for own in messages if not own.is_command]
        self._beat = Every(PERIOD, 0.0)

    def power_on(self, now: float) -> None:
        """The board starts."""
        self._beat = Every(PERIOD, now)

    def due(self) -> Optional[float]:
        """When `messages` has the next ones."""
        return self._beat.due if self._kinds else None

    def messages(self, now: float) -> List[Any]:
        """What is to be sent now."""
        if not self._kinds or not self._beat.passed(now):
            return []
        return [kind(*wandering(kind.LAYOUT, now)) for kind in self._kinds]


def wandering(layout: Layout, now: float) -> Tuple:
    """Values that a message may have at that time."""
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
    number = low + (high - low) * (0.5 + 0.49 * math.sin(2 * math.pi * now / _TURN + index))
    if value.may_be_nan:
        return number
    # The nearest whole raw number within the limits.
    ends = sorted(((low - value.offset) / value.scale, (high - value.offset) / value.scale))
    raw = min(max(round((number - value.offset) / value.scale), math.ceil(ends[0] - 1e-9)),
              math.floor(ends[1] + 1e-9))
    return value.scaled(raw)


def _text(value: Value, now: float) -> str:
    return f'simulated {now:.0f}'[:value.room]
