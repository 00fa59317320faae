"""Rows: the messages, commands, functions and settings of a board, built in or not.

Parameters and announcements hold rows by name, with the keys that config/custom_messages.yaml
shows; a `Group` reads them. ROS types and topics stay text here; `ros` resolves them.
"""
import enum
import re
import struct
from contextlib import suppress
from dataclasses import dataclass, field
from math import inf, isfinite, isnan, nan
from typing import (Any, Callable, Dict, Iterable, List, NamedTuple, Optional, Pattern, Sequence,
                    Tuple)

from .layout import (BOARD_TIME, EMPTY, FRACTIONS, Layout, Value, brief, count_values,
                     message_class, readable, shortest)

BUILT_IN, FILE, BOARD = 'built in', 'file', 'board'      # where a row is from
# Types from this one on have a meaning of their own on every link: settings, time, announcements.
RESERVED = 253
SETTING_KEY = 'setting'      # a row with this key is a setting
MOTIONS = 'geometry_msgs/Twist', 'geometry_msgs/TwistStamped'     # by default
_NAME = re.compile(r'[A-Za-z][A-Za-z0-9_]*')
_STEP = r'[A-Za-z][A-Za-z0-9_]*(\[[0-9]{1,9}\])?'
_PATH = re.compile(rf'({_STEP}(\.{_STEP})*)?')
_ROS_TYPE = re.compile(r'[A-Za-z][A-Za-z0-9_]*/[A-Za-z][A-Za-z0-9_]*')
_SETTING = re.compile('<[?bBhHiIf]')
_HUGE = 2 ** 64     # greater than any raw number


class Kind(enum.Enum):
    """What a row is."""

    FROM = 'from_board'      # a message of the board: a topic
    TO = 'to_board'          # a command: a subscription
    FUNCTION = 'function'    # a request with a reply: a service, or a topic that is polled
    SETTING = 'setting'      # a number of the firmware that changes while it runs


_NUMBERS = {Kind.FROM: 'type', Kind.TO: 'type', Kind.FUNCTION: 'cmd2', Kind.SETTING: SETTING_KEY}
_LAYOUT_KEYS = 'layout', 'fields', 'scale', 'offset', 'minimum', 'maximum', 'invalid'
_TOPIC_KEYS = 'ros_type', 'frame_id', 'child_frame_id', 'constants'
_KEYS = {
    'type': ('type', 'direction', *_TOPIC_KEYS, 'motion', *_LAYOUT_KEYS),
    'cmd2': ('cmd2', 'srv_type', *_TOPIC_KEYS, 'period', 'request', 'reply', 'timeout',
             'repeatable', 'interrupts'),
    SETTING_KEY: (SETTING_KEY, 'layout', 'minimum', 'maximum', 'unit', 'description')}


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
    motion: bool = False          # a command that moves something: see doc/protocols.md
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
            least, most = value.range
            low, high = value.limits
            if not max(low, least) <= given <= min(high, most):
                sent[index] = max(value.minimum, least) if given < low or given < least else \
                    min(value.maximum, most)
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

    def allowed(self) -> str:
        """The allowed values in words."""
        if self.code == '?':
            return 'may be true or false'
        kind = 'number' if self.code in FRACTIONS else 'whole number'
        least, most = self.layout.values[1].range
        low = '' if self.minimum == least else f' from {self.minimum:.10g}'
        high = '' if self.maximum == most else f' to {self.maximum:.10g}'
        return f'may be a {kind}{low}{high} {self.unit}'.rstrip()

    def checked(self, value: Any) -> Any:
        """The value as the board will have it, rounded to what its layout holds.

        Raises:
            ValueError: it is not allowed; the text says what is.
        """
        is_float = self.code in FRACTIONS
        with suppress(struct.error, OverflowError):     # its place cannot hold it
            if type(value) in (bool, int, float) and self.minimum <= (
                    shortest(value) if is_float else value) <= self.maximum:
                value = self.layout.unpack(self.layout.pack((self.number, value)))[1]
                return shortest(value) if is_float else value
        raise ValueError(self.allowed())


class Group(NamedTuple):
    """The rows in one parameter of a board, and what they may be."""

    parameter: str                # messages, functions, settings
    prefix: str                   # prefix + the row's name is the name of its topic or service
    kinds: Tuple[Kind, ...] = (Kind.FROM,)
    numbers: Sequence[int] = range(256)    # the allowed ones, sorted
    longest: int = 0              # bytes of data
    make: Callable[..., Any] = Row

    def read(self, entries: Any, key: str, origin: str = FILE) -> List[Any]:
        """The rows of a parameter `key`, as ``arduino/messages``.

        Raises:
            RowError: a row cannot be used; the first of them is reported.
        """
        if not isinstance(entries, dict):
            raise RowError(key, entries, 'may be a group of rows, each with a name')
        found: List[Row] = []
        for name in sorted(entries, key=str):
            if type(name) is not str or not _NAME.fullmatch(name):
                raise RowError(f'{key}/{name}', name, 'may have a name of letters, digits and _ '
                               'that begins with a letter')
            row = self._row(name, _Keys(f'{key}/{name}', entries[name],
                                        _KEYS[_NUMBERS[self.kinds[0]]]), origin)
            refuse_second_number(row, found)
            found.append(row)
        return found

    def _row(self, name: str, keys: '_Keys', origin: str) -> Any:
        key = _NUMBERS[self.kinds[0]]
        if key == 'cmd2' and ('srv_type' in keys.given) == ('ros_type' in keys.given):
            raise RowError(keys.key, None if keys.given else {}, 'has either srv_type or ros_type')
        number = keys.number(key, lambda n: n in self.numbers, _words(self.numbers), whole=True)
        found = {'type': _message, 'cmd2': _function, SETTING_KEY: _setting}[key](self, keys)
        if key == 'type':
            message = message_class(name, number, found['layout'].layout, found['layout'].values)
            message.ANNOUNCED = origin == BOARD
            found.update(message=message, layout=message.LAYOUT)
        return self.make(name, number, key=keys.key, origin=origin, **found)


def refuse_second_number(row: Row, others: Iterable[Row]) -> None:
    """Raise RowError if another row has the number of this one."""
    for other in others:
        if (row.number_key, row.number) == (other.number_key, other.number):
            raise RowError(f'{row.key}/{row.number_key}', row.number,
                           f'is already the {row.number_key} of {other.name}')


def _words(numbers: Sequence[int]) -> str:
    """The allowed numbers in words."""
    gaps = sorted(set(range(numbers[0], numbers[-1])) - set(numbers))
    return f'a whole number from {numbers[0]} to {numbers[-1]}' + (
        f' but {", ".join(map(str, gaps))}' if gaps else '')


def _message(group: Group, keys: '_Keys') -> Dict[str, Any]:
    direction = keys.given.get('direction', Kind.FROM.value)
    allowed = [kind.value for kind in group.kinds]
    if direction not in allowed:
        raise RowError(keys.name('direction'), direction, f'may be {" or ".join(allowed)}')
    kind = Kind(direction)
    keys.refuse_unused(('motion',) if kind is Kind.FROM else ('constants', 'invalid'),
                       f'direction: {direction}')
    ros_type = keys.text('ros_type', _ROS_TYPE, 'a message type, as std_msgs/Float32')
    motion = kind is Kind.TO and keys.flag('motion', ros_type in MOTIONS)
    layout = keys.layout(group.longest, kind is Kind.FROM)
    if motion:
        keys.check_motion(layout)
    return dict(keys.topic(), kind=kind, layout=layout, ros_type=ros_type, motion=motion,
                newest=motion)


def _function(group: Group, keys: '_Keys') -> Dict[str, Any]:
    is_polled = 'ros_type' in keys.given
    keys.refuse_unused(*(('repeatable', 'interrupts'), 'ros_type') if is_polled else
                       (('period', 'frame_id', 'child_frame_id', 'constants'), 'srv_type'))
    request, reply = (keys.inner(part, group.longest) for part in ('request', 'reply'))
    if is_polled and any(value.name for value in request.values):
        raise RowError(keys.name('request/fields'), keys.given['request']['fields'], 'may be empty '
                       'texts only: a polled request has no message to take values from')
    found = dict(
        keys.topic(), layout=request, reply=reply,
        ros_type=keys.text('ros_type', _ROS_TYPE, 'a message type, as std_msgs/Float32')
        if is_polled else keys.text('srv_type', _ROS_TYPE, 'a service type, as std_srvs/Trigger'),
        period=keys.number('period', lambda n: 0.001 <= n <= 86400,
                           'a number from 0.001 to 86400 (s)') if is_polled else 0.0,
        timeout=keys.number('timeout', lambda n: 0.01 <= n <= 600,
                            'a number from 0.01 to 600 (s)', default=0.0) or None,
        repeatable=keys.flag('repeatable', is_polled), interrupts=keys.flag('interrupts'))
    if found['interrupts'] and not found['repeatable']:
        raise RowError(keys.name('repeatable'), False,
                       'has to be true where interrupts is true: it is sent more than once')
    return found


def _setting(_group: Group, keys: '_Keys') -> Dict[str, Any]:
    name = keys.key.rpartition('/')[2]
    if name == 'groups':     # dynamic_reconfigure has another meaning for it
        raise RowError(keys.key, name, 'may not be the name of a setting')
    code = keys.text('layout', _SETTING, '< and one of ? b B h H i I f')[1:]
    if code == '?':
        keys.refuse_unused(('minimum', 'maximum'), 'layout: <?')
    is_float = code in FRACTIONS
    low, high = Value('', code=code).range
    limits = [(float if is_float else int)(keys.number(
        key, lambda n: low <= n <= high and (is_float or n == int(n)),
        f'a {"" if is_float else "whole "}number from {low:.10g} to {high:.10g}', default))
        for key, default in (('minimum', low), ('maximum', high))]
    if limits[0] > limits[1]:
        raise RowError(keys.name('minimum'), limits[0],
                       f'may be at most the maximum, {limits[1]:g}')
    unit = keys.text('unit', None, 'text', '')
    value = Value(name, unit)
    if is_float:     # NaN and infinity are implausible; what a float32 makes of a limit is allowed
        value = value._replace(minimum=low, maximum=high)
        limits = [min(limits[0], shortest(limits[0])), max(limits[1], shortest(limits[1]))]
    return dict(layout=Layout('<B' + code, [Value('number'), value]), minimum=limits[0],
                maximum=limits[1], unit=unit,
                description=' '.join(keys.text('description', None, 'text', '').split()))


class _Keys:
    """Reads and checks the keys of one row; every method raises RowError for a wrong value.

    Args:
        key: of the row, as ``arduino/messages/force``.
        given: its keys with their values.
        keys: the allowed keys.
    """

    def __init__(self, key: str, given: Any, keys: Sequence[str]) -> None:
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
        value = self.given.get(key, default)
        if type(value) is not str or (pattern and not pattern.fullmatch(value)):
            raise self._error(key, f'may be {allowed}')
        return value

    def flag(self, key: str, default: bool = False) -> bool:
        """Whether a key is true."""
        value = self.given.get(key, default)
        if type(value) is not bool:
            raise self._error(key, 'may be true or false')
        return value

    def refuse_unused(self, keys: Iterable[str], beside: str) -> None:
        """Refuse keys that have no meaning beside another one."""
        for key in keys:
            if key in self.given:
                raise self._error(key, f'has no meaning beside {beside}')

    def topic(self) -> Dict[str, Any]:
        """What else the message of a topic has: its frames and its constants."""
        frame_id = self.text('frame_id', None, 'text', '')
        child = self.text('child_frame_id', None, 'text', '')
        if child and frame_id in ('', child):
            raise self._error('child_frame_id', 'needs a frame_id, of another frame')
        return dict(frame_id=frame_id, child_frame_id=child, constants=self._constants())

    def _constants(self) -> Dict[str, Any]:
        """A number, true, false, a text, or a list of these, for each path."""
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
        # One object for all NaN, which is equal to itself: rows are compared.
        return {path: [nan if each != each else each for each in value] if type(value) is list
                else nan if value != value else value for path, value in given.items()}

    def check_motion(self, layout: Layout) -> None:
        """Refuse a motion that cannot be stopped by a zero of a fixed length."""
        if not all(value.kind == 'number' for value in layout.values):
            raise self._error('layout', 'may have numbers and bools alone, of a fixed length: it '
                              'is a motion (else: motion: false)')
        for value in layout.values:
            for key, excludes in ('minimum', value.limits[0] > 0), ('maximum',
                                                                    value.limits[1] < 0):
                if excludes:
                    raise self._error(key, 'has to allow the zero of a motion')
        try:
            layout.pack([0] * len(layout.values))
        except ValueError as error:
            raise self._error('offset', f'has to allow the zero of a motion: {error}') from None

    def inner(self, key: str, longest: int) -> Layout:
        """The layout of the DATE of a request or a reply."""
        if key not in self.given:
            return EMPTY
        keys = _Keys(self.name(key), self.given[key], _LAYOUT_KEYS)
        layout = keys.layout(longest)
        if key == 'request':
            keys.refuse_unused(['invalid'], 'a request, which is sent to the board')
        return layout

    def layout(self, longest: int, may_be_timed: bool = False) -> Layout:
        """The layout by the keys `_LAYOUT_KEYS`, of at most `longest` bytes of data.

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
        scales = self._each('scale', count, 1, lambda n: _is_number(n) and n != 0 and abs(n) < inf,
                            'a number but 0')
        offsets = self._each('offset', count, 0, lambda n: _is_number(n) and abs(n) < inf)
        minima, maxima = self._each('minimum', count, -inf), self._each('maximum', count, inf)
        invalid = self._each('invalid', count, '', lambda n: n == '' or _is_number(n),
                             'a number, or an empty text for none')
        values = Layout(layout, [
            Value(path, 'us') if path == BOARD_TIME else Value(
                path, '', _factor(scale), _factor(offset), minimum, maximum)
            for path, scale, offset, minimum, maximum in zip(
                paths, scales, offsets, minima, maxima)]).values
        for value in values:
            if value.name == BOARD_TIME and (value.code != 'I' or value.kind != 'number'):
                raise self._error('fields', f'may have {BOARD_TIME} at an I of the layout')
            if value.minimum > value.maximum:
                raise self._error('minimum', f'may be at most the maximum, {value.maximum:g}')
        return Layout(layout, self._with_invalid(values, invalid))

    def _each(self, key: str, count: int, default: Any,
              may_be: Callable[[Any], bool] = lambda n: _is_number(n),
              allowed: str = 'a number') -> List[Any]:
        """A number for each value, from a list or from one number for all."""
        given = self.given.get(key, default)
        numbers = given if type(given) is list else [given] * count
        if len(numbers) != count or not all(map(may_be, numbers)):
            raise self._error(key, f'may be {allowed}, or a list of {count}')
        return numbers

    def _with_invalid(self, values: Sequence[Value], invalid: Sequence[Any]) -> List[Value]:
        """The values with their raw numbers that mean "no value".

        A list has to fit all values; one number for all has to fit one of them.
        """
        fits = [value.name != BOARD_TIME and number != '' and value.holds(number)
                for value, number in zip(values, invalid)]
        misfits = [value.code for value, number, fit in zip(values, invalid, fits)
                   if number != '' and not fit]
        if misfits and (type(self.given['invalid']) is list or not any(fits)):
            raise self._error('invalid', 'may be a raw number that its place '
                              f'({misfits[0]}) can hold exactly')
        return [value._replace(invalid=number) if fit else value
                for value, number, fit in zip(values, invalid, fits)]


def _factor(number: Any) -> Any:
    """Whole numbers stay whole, except where a product with a raw number could overflow a float."""
    return number if abs(number) < _HUGE else float(number)


def _is_number(value: Any) -> bool:
    """Whether it is a number that a float can represent, and not NaN."""
    try:
        return type(value) in (int, float) and not isnan(value)
    except OverflowError:
        return False
