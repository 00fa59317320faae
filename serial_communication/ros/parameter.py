"""A parameter's type and range, and the parameters that several boards share."""
from math import inf, isfinite
from typing import Any, Callable, Dict, NamedTuple, Tuple

from ..boards.description import BAUD_RANGE, Description
from ..framing.layout import readable
from ..transport.urls import check_url

_KINDS = {bool: 'true or false', str: 'text', int: 'a whole number', float: 'a number',
          dict: 'a group'}


class ParameterError(ValueError):
    """A parameter's value is wrong; the text is one line for users."""

    def __init__(self, text: str) -> None:
        super().__init__(readable(text))


class Parameter(NamedTuple):
    """One parameter. Its type is that of its default.

    A list has as many numbers as its default. An empty list and a group (a dict) are checked by
    `parse` alone.
    """

    default: Any
    low: float = -inf
    high: float = inf
    choices: Tuple = ()
    unit: str = ''
    parse: Callable[[Any], Any] = lambda value: value    # returns it; ValueError if it is wrong

    def allowed(self) -> str:
        """Return the allowed values as text, such as ``may be a number from 0 to 1 (s)``."""
        if self.choices:
            return 'may be ' + ' or '.join(repr(choice) for choice in self.choices)
        kind = _KINDS.get(type(self.default)) or (
            f'a list of {len(self.default)} numbers' if self.default else 'a list')
        bounds = f' from {self.low:g} to {self.high:.10g}' if isfinite(self.low) else ''
        return f'may be {kind}{bounds}' + (f' ({self.unit})' if self.unit else '')

    def check(self, value: Any) -> Any:
        """Return the value as the parameter's type; ValueError if it is of another or out of
        range."""
        wanted = type(self.default)
        if wanted is float and type(value) is int:
            value = float(value)
        if self.default in ({}, []):
            return self.parse(value)
        if type(value) is not wanted or self.choices and value not in self.choices:
            raise ValueError
        if wanted in (int, float) and not self.low <= value <= self.high:
            raise ValueError    # NaN fails this as well
        if wanted is list:
            if len(value) != len(self.default) or not all(
                    type(item) in (int, float) and isfinite(item) for item in value):
                raise ValueError
            value = [float(item) for item in value]
        return self.parse(value)


Parameters = Dict[str, Parameter]     # by name; a board's without the prefix ``BOARD/``


def seconds(default: float, low: float, high: float) -> Parameter:
    """Return a parameter that is a time; all values in s."""
    return Parameter(default, low, high, unit='s')


def frame_id(default: str) -> Parameter:
    """Return a parameter that is a frame id; the node puts `frame_prefix` before it."""
    return Parameter(default, parse=not_empty)


def not_empty(text: str) -> str:
    """Return the text; raise ValueError if it is empty."""
    if not text:
        raise ValueError
    return text


def baud(board: Description) -> Parameter:
    """Return the parameter `baud` of a board: its default is the description's."""
    return Parameter(board.baud, *BAUD_RANGE, unit='baud')


def _port(url: str) -> str:
    if url:
        check_url(url)
    return url


PORT = Parameter('', parse=_port)     # empty: the link is off
RESET_LINE = Parameter('', choices=('', 'dtr', 'rts'))    # empty: no line resets the board
MOUNT = Parameter([0.0] * 6, unit='x y z in m, roll pitch yaw in rad, in base_frame_id')
