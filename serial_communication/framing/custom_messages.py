"""Rows of parameters -> custom messages.

A board's ``messages`` hold one row for each custom message, by name, with the keys that
config/custom_messages.yaml shows. This module makes message classes and layouts of them. ROS types
and topics stay text here; `ros` resolves them.
"""
import re
from math import inf, isnan
from typing import (Any, Callable, Dict, Iterable, List, NamedTuple, Optional, Pattern,
                    Sequence, Tuple, Type)

from .layout import (BOARD_TIME, Layout, LayoutMessage, Value, brief, count_values,
                     message_class, readable)

FROM_BOARD, TO_BOARD = 'from_board', 'to_board'
_NAME = re.compile(r'[A-Za-z][A-Za-z0-9_]*')
_STEP = r'[A-Za-z][A-Za-z0-9_]*(\[[0-9]{1,9}\])?'
_PATH = re.compile(rf'({_STEP}(\.{_STEP})*)?')
ROS_TYPE = re.compile(r'[A-Za-z][A-Za-z0-9_]*/[A-Za-z][A-Za-z0-9_]*')
LAYOUT_KEYS = ('layout', 'fields', 'scale', 'offset', 'minimum', 'maximum', 'invalid')
_MESSAGE_KEYS = ('type', 'direction', 'ros_type', 'frame_id', 'child_frame_id',
                 'constants') + LAYOUT_KEYS
# Types from this one on have a meaning of their own on every link: settings, time, announcements.
RESERVED = 253
_HUGE = 2 ** 64     # greater than any raw number


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


class CustomMessage(NamedTuple):
    """What a row of ``messages`` describes."""

    name: str
    key: str               # of the row, as arduino/messages/force
    kind: Type[LayoutMessage]    # the names of its values are paths of ROS fields
    is_command: bool       # sent to the board
    ros_type: str
    frame_id: str
    constants: Dict[str, Any]     # values by path, of fields that the board does not send
    child_frame_id: str = ''

    @property
    def number(self) -> Tuple[str, int]:
        """The key of its number on the wire, and that number."""
        return 'type', self.kind.TYPE


def meaning(row: Any) -> Tuple:
    """What a custom message or function is, for comparisons: all but the parameter it is from."""
    return tuple(_comparable(value) for name, value in zip(row._fields, row) if name != 'key')


def _comparable(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _comparable(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_comparable(each) for each in value]
    if isinstance(value, float) and isnan(value):
        return 'NaN'     # which is not equal to itself
    layout = value if isinstance(value, Layout) else getattr(value, 'LAYOUT', None)
    return value if layout is None else (getattr(value, 'TYPE', None), layout.layout,
                                         layout.values)


def read_messages(entries: Any, key: str, types: Sequence[int], longest: int,
                  directions: Tuple[str, ...] = (FROM_BOARD,)) -> List[CustomMessage]:
    """The custom messages of a board.

    Args:
        entries: the rows, by name.
        key: their parameter, as ``arduino/messages``.
        types: the allowed types, sorted.
        longest: the most bytes of data that a message may have.
        directions: the allowed directions.

    Raises:
        RowError: a row cannot be used; the first of them is reported.
    """
    messages: List[CustomMessage] = []
    for name, row in rows(entries, key, _MESSAGE_KEYS):
        type_ = row.number('type', lambda n: n in types, f'a whole number from {types[0]} to '
                           f'{types[-1]} that no message of the board has', whole=True)
        row.refuse_second('type', type_, {other.kind.TYPE: other.name for other in messages})
        direction = row.given.get('direction', FROM_BOARD)
        if direction not in directions:
            raise RowError(row.name('direction'), direction, f'may be {" or ".join(directions)}')
        if direction == TO_BOARD:
            row.refuse_unused(['constants', 'invalid'], 'direction: to_board')
        ros_type = row.text('ros_type', ROS_TYPE, 'a message type, as std_msgs/Float32')
        kind = message_class(name, type_, *row.layout(longest, direction == FROM_BOARD))
        messages.append(CustomMessage(name, row.key, kind, direction == TO_BOARD, ros_type,
                                      row.text('frame_id', None, 'text', ''), row.constants(),
                                      row.child_frame_id()))
    return messages


class Row:
    """One row: reads its keys and checks them.

    Every method raises RowError for a value that is not allowed.

    Args:
        key: of the row, as ``arduino/messages/force``.
        given: its keys with their values.
        keys: the allowed keys.
    """

    def __init__(self, key: str, given: Any, keys: Tuple[str, ...]) -> None:
        self.key = key
        self.given: Dict[str, Any] = given
        if not isinstance(given, dict):
            raise RowError(key, given, f'may be a group with the keys {", ".join(keys)}')
        for unknown in given:
            if unknown not in keys:
                raise self._error(unknown, f'is not a key of a row; {", ".join(keys)}')

    def name(self, key: str) -> str:
        """The full name of a key's parameter."""
        return f'{self.key}/{key}'

    def _error(self, key: str, allowed: str) -> RowError:
        return RowError(self.name(key), self.given.get(key), allowed)

    def number(self, key: str, may_be: Callable[[float], bool], allowed: str,
               default: Optional[float] = None, whole: bool = False) -> Any:
        """The number of a key, for which `may_be` is true; `allowed` says which these are."""
        value = self.given.get(key, default)
        is_number = type(value) in ((int,) if whole else (int, float))
        if not is_number or (key in self.given and not may_be(value)):
            raise self._error(key, f'may be {allowed}')
        return value

    def text(self, key: str, pattern: Optional[Pattern[str]], allowed: str,
             default: Optional[str] = None) -> str:
        """The text of a key, which matches the pattern."""
        if default is not None and key not in self.given:
            return default
        value = self.given.get(key)
        if type(value) is not str or (pattern and not pattern.fullmatch(value)):
            raise self._error(key, f'may be {allowed}')
        return value

    def flag(self, key: str) -> bool:
        """Whether a key is true; the default is false."""
        value = self.given.get(key, False)
        if type(value) is not bool:
            raise self._error(key, 'may be true or false')
        return value

    def constants(self) -> Dict[str, Any]:
        """The constants: a number, true, false, a text, or a list of these, for each path."""
        given = self.given.get('constants', {})
        if type(given) is not dict or not all(
                type(path) is str and path and _PATH.fullmatch(path) for path in given):
            raise self._error('constants', 'may be a group with a value for the path of each '
                              'field, as {present: true}')
        for path, value in given.items():
            if not all(type(each) in (bool, int, float, str)
                       for each in (value if type(value) is list else [value])):
                raise RowError(f'{self.name("constants")}/{path}', value,
                               'may be a number, true, false or a text, or a list of these')
        return given

    def child_frame_id(self) -> str:
        """The frame whose pose, in `frame_id`, the message has; '': none is given."""
        child = self.text('child_frame_id', None, 'text', '')
        if child and self.given.get('frame_id', '') in ('', child):
            raise self._error('child_frame_id', 'needs a frame_id, of another frame')
        return child

    def refuse_unused(self, keys: Iterable[str], beside: str) -> None:
        """Refuse keys that have no meaning beside another one."""
        for key in keys:
            if key in self.given:
                raise self._error(key, f'has no meaning beside {beside}')

    def refuse_second(self, key: str, value: int, names: Dict[int, str]) -> None:
        """Refuse a number that another row has; `names` are the rows by number."""
        if value in names:
            raise self._error(key, f'is already the {key} of {names[value]}')

    def layout(self, longest: int, may_be_timed: bool = False) -> Tuple[str, List[Value]]:
        """The format and its values, by the keys `LAYOUT_KEYS`; at most `longest` bytes of data.

        One value may be the board's time, `BOARD_TIME`, if `may_be_timed`.
        """
        layout = self.text('layout', None, 'a format of Python\'s struct, as <hB')
        paths = self.given.get('fields')
        if type(paths) is not list or not all(
                type(path) is str and (path == BOARD_TIME or _PATH.fullmatch(path))
                for path in paths):
            raise self._error('fields', 'may be a list with the path of a field for each value, '
                              'as [vector.x, "", position[2]]')
        try:
            count = count_values(layout, longest)
        except ValueError as error:
            raise self._error('layout', 'may be a format of Python\'s struct, as <hB: '
                              f'{error}') from None
        if count is None:
            raise self._error('layout', f'may have at most {longest} bytes')
        if len(paths) != count:
            raise self._error('fields', f'may be a list of {count}, one for each value of the '
                              f'layout {layout}')
        for path in paths:
            if path and paths.count(path) > 1:
                raise self._error('fields', f'may have {path} once')
        if BOARD_TIME in paths and not may_be_timed:
            raise self._error('fields', f'may have {BOARD_TIME} in a message from the board')
        scales = self._each('scale', count, 1, lambda n: abs(n) < inf and n != 0, 'a number but 0')
        offsets = self._each('offset', count, 0, lambda n: abs(n) < inf)
        minima, maxima = self._each('minimum', count, -inf), self._each('maximum', count, inf)
        values = Layout(layout, [
            Value(path, 'us') if path == BOARD_TIME else
            Value(path, '', scale, offset, minimum, maximum) for path, scale, offset, minimum,
            maximum in zip(paths, scales, offsets, minima, maxima)]).values
        if any(value.name == BOARD_TIME and (value.code != 'I' or value.kind != 'number')
               for value in values):
            raise self._error('fields', f'may have {BOARD_TIME} at an I of the layout')
        self._check_limits(values)
        return layout, self._with_invalid(values)

    def _each(self, key: str, count: int, default: float,
              may_be: Callable[[float], bool] = lambda n: True,
              allowed: str = 'a number') -> List[float]:
        """A number for each value, from a list or from one number for all."""
        given = self.given.get(key, default)
        numbers = given if type(given) is list else [given] * count
        if len(numbers) != count or not all(
                _is_number(number) and may_be(number) for number in numbers):
            raise self._error(key, f'may be {allowed}, or a list of {count}')
        # Whole numbers stay whole, except where a product with a raw number could overflow a float.
        return [number if abs(number) < _HUGE else float(number) for number in numbers]

    def _enough(self, key: str, fits: Sequence[bool]) -> bool:
        """Whether the numbers in a list fit all values, or one number for all fits any of them."""
        return all(fits) if type(self.given[key]) is list else any(fits)

    def _with_invalid(self, values: Sequence[Value]) -> List[Value]:
        """The values with their raw numbers that mean "no value"; in a list '' means none."""
        if 'invalid' not in self.given:
            return list(values)
        given = self.given['invalid']
        numbers = given if type(given) is list else [given] * len(values)
        if len(numbers) != len(values) or not all(
                _is_number(number) or number == '' and type(given) is list for number in numbers):
            raise self._error('invalid', f'may be a number, or a list of {len(values)} with a '
                              'number or an empty text for each value')
        fits = [number == '' or value.name != BOARD_TIME and value.holds(number)
                for number, value in zip(numbers, values)]
        if not self._enough('invalid', fits):
            code = values[fits.index(False)].code if values else ''
            raise self._error('invalid', 'may be a raw number that its place '
                              f'({code}) can hold exactly')
        return [value._replace(invalid=number) if fit and number != '' else value
                for number, fit, value in zip(numbers, fits, values)]

    def _check_limits(self, values: Sequence[Value]) -> None:
        """Refuse a limit that no raw number reaches, and a minimum above its maximum."""
        limited = [value for value in values
                   if value.name not in ('', BOARD_TIME) and value.kind != 'text']
        for key in ('minimum', 'maximum'):
            fits = [any(value.range[0] <= made <= value.range[1] or abs(made) == inf
                        for made in value.made_of(getattr(value, key))) for value in limited]
            if limited and self.given.get(key) is not None and not self._enough(key, fits):
                low, high = limited[fits.index(False)].range
                raise self._error(key, f'may be from {low:.10g} to {high:.10g}, which is what its '
                                  'place holds')
        for value in limited:
            if value.minimum > value.maximum:
                raise self._error('minimum', f'may be at most the maximum, {value.maximum:g}')


def _is_number(value: Any) -> bool:
    """Whether it is a number that a float can represent, and not NaN."""
    try:
        return type(value) in (int, float) and not isnan(value)
    except OverflowError:
        return False


def rows(entries: Any, key: str, keys: Tuple[str, ...]) -> List[Tuple[str, Row]]:
    """All rows with their names, sorted.

    Raises:
        RowError: `entries` is not a group of rows, or a row is not a group of the allowed keys.
    """
    if not isinstance(entries, dict):
        raise RowError(key, entries, 'may be a group of rows, each with a name')
    for name in entries:
        if type(name) is not str or not _NAME.fullmatch(name):
            raise RowError(f'{key}/{name}', name, 'may have a name of letters, digits and _ that '
                           'begins with a letter')
    return [(name, Row(f'{key}/{name}', entries[name], keys)) for name in sorted(entries)]
