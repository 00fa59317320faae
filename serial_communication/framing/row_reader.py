"""Reads the rows of a board from its parameters, or as the board announces them.

Both hold rows by name, with the keys that config/custom_messages.yaml shows.
"""
import re
from math import inf, isnan, nan
from typing import Any, Callable, Dict, List, NamedTuple, Sequence, Tuple

from .layout import (BOARD_TIME, EMPTY, FRACTIONS, Layout, Value, message_class, places_of,
                     readable, shortest)
from .rows import BOARD, FILE, Kind, Row, RowError, refuse_second_number
from .stream import SETTING

MOTIONS = 'geometry_msgs/Twist', 'geometry_msgs/TwistStamped'     # by default
_NAME = re.compile(r'[A-Za-z][A-Za-z0-9_]*')
_STEP = r'[A-Za-z][A-Za-z0-9_]*(\[[0-9]{1,9}\])?'
_PATH = re.compile(rf'({_STEP}(\.{_STEP})*)?')
_HUGE = 1e30        # so that a product of whole numbers fits a float
_SENT_KEYS = 'layout', 'fields', 'scale', 'offset', 'minimum', 'maximum'
_LAYOUT_KEYS = (*_SENT_KEYS, 'invalid')
_FRAME_KEYS = 'frame_id', 'child_frame_id'
_KEYS = {
    Kind.FROM: ('type', 'direction', 'ros_type', *_FRAME_KEYS, 'constants', *_LAYOUT_KEYS),
    Kind.TO: ('type', 'direction', 'ros_type', *_FRAME_KEYS, 'motion', *_SENT_KEYS)}
_FUNCTION_KEYS = 'cmd2', 'request', 'reply', 'timeout'
_SERVICE_KEYS = (*_FUNCTION_KEYS, 'srv_type', 'repeatable', 'interrupts')
_POLLED_KEYS = (*_FUNCTION_KEYS, 'ros_type', *_FRAME_KEYS, 'constants', 'period')
_SETTING_KEYS = 'setting', 'layout', 'unit', 'description'


def _text(pattern: str = '(?s).*') -> Callable[[Any], bool]:
    # With a control character it could neither be published nor be set on the parameter server.
    return lambda value: type(value) is str and value == readable(value) \
        and bool(re.fullmatch(pattern, value))


def _number(low: float, high: float) -> Callable[[Any], bool]:
    return lambda value: type(value) in (int, float) and low <= value <= high


# What the value of a key may be: a test, in words, and the default; None: it is required.
_CHECKS: Dict[str, Tuple[Callable[[Any], bool], str, Any]] = {
    'ros_type': (_text(f'{_NAME.pattern}/{_NAME.pattern}'),
                 'a message type, as std_msgs/Float32', None),
    'srv_type': (_text(f'{_NAME.pattern}/{_NAME.pattern}'),
                 'a service type, as std_srvs/Trigger', None),
    'layout': (_text(), 'a format of Python\'s struct, as <hB', None),
    'period': (_number(0.001, 86400), 'a number from 0.001 to 86400 (s)', None),
    'timeout': (_number(0.01, 600), 'a number from 0.01 to 600 (s)', 0.0),
    **dict.fromkeys(('frame_id', 'child_frame_id', 'unit', 'description'), (_text(), 'text', '')),
    **dict.fromkeys(('motion', 'repeatable', 'interrupts'),
                    (lambda value: type(value) is bool, 'true or false', False)),
    'constants': (lambda given: type(given) is dict and all(
        path and _text(_PATH.pattern)(path) and (type(value) is not str or _text()(value))
        for path, value in given.items()),
        'a group with a value for the path of each field, as {present: true}', {})}


class Group(NamedTuple):
    """The rows in one parameter of a board, and what they may be."""

    parameter: str                # messages, functions, settings
    prefix: str                   # prefix + the row's name is the name of its topic or service
    kinds: Tuple[Kind, ...] = (Kind.FROM,)
    numbers: Sequence[int] = range(256)    # the allowed ones, sorted
    longest: int = 0              # bytes of data
    make: Callable[..., Any] = Row

    def read(self, entries: Any, key: str, origin: str = FILE) -> List[Any]:
        """The rows of the parameter ``arduino/messages``; RowError for the first mistake."""
        if not isinstance(entries, dict):
            raise RowError(key, entries, 'may be a group of rows, each with a name')
        found: List[Row] = []
        for name in sorted(entries, key=str):
            if type(name) is not str or not _NAME.fullmatch(name):
                raise RowError(f'{key}/{name}', name, 'may have a name of letters, digits and _ '
                               'that begins with a letter')
            found.append(self._row(name, entries[name], f'{key}/{name}', origin))
            refuse_second_number(found[-1], found[:-1])
        return found

    def _row(self, name: str, given: Any, key: str, origin: str) -> Any:
        keys = _Keys(key, given)
        number_key = Row('', kind=self.kinds[0]).number_key
        gaps = [str(each) for each in range(self.numbers[0], self.numbers[-1])
                if each not in self.numbers]
        number = keys.get(number_key, lambda n: type(n) is int and n in self.numbers,
                          f'a whole number from {self.numbers[0]} to {self.numbers[-1]}'
                          + (f' but {", ".join(gaps)}' if gaps else ''))
        found = {'type': _message, 'cmd2': _function, 'setting': _setting}[number_key](self, keys)
        if number_key != 'cmd2':
            is_setting, layout = number_key == 'setting', found['layout']
            message = found['message'] = message_class(
                name, SETTING if is_setting else number, layout.layout, layout.values,
                'setting' if is_setting else '')
            message.ANNOUNCED = origin == BOARD
            message.NUMBER = bytes((number,)) if is_setting else b''
        return self.make(name, number, key=key, origin=origin, **found)


def _message(group: Group, keys: '_Keys') -> Dict[str, Any]:
    allowed = [kind.value for kind in group.kinds]
    kind = Kind(keys.get('direction', lambda value: value in allowed, ' or '.join(allowed),
                         Kind.FROM.value))
    keys.refuse_others(_KEYS[kind])
    layout = keys.layout(group.longest, kind is Kind.FROM)
    topic = keys.topic()
    motion = keys['motion'] if 'motion' in keys.given else \
        kind is Kind.TO and topic['ros_type'] in MOTIONS
    if motion:
        keys.check_motion(layout)
    return dict(topic, kind=kind, layout=layout, motion=motion, newest=motion)


def _function(group: Group, keys: '_Keys') -> Dict[str, Any]:
    is_polled = 'ros_type' in keys.given
    if is_polled == ('srv_type' in keys.given):
        raise RowError(keys.key, keys.given, 'has either srv_type or ros_type')
    keys.refuse_others(_POLLED_KEYS if is_polled else _SERVICE_KEYS)
    request = keys.inner('request', group.longest, _SENT_KEYS)
    reply = keys.inner('reply', group.longest, _LAYOUT_KEYS)
    if is_polled and any(value.name for value in request.values):
        raise RowError(f'{keys.key}/request/fields', keys.given['request']['fields'], 'may be '
                       'empty texts only: a polled request has no message to take values from')
    if keys['interrupts'] and not keys['repeatable']:
        raise RowError(f'{keys.key}/repeatable', False,
                       'has to be true where interrupts is true: it is sent more than once')
    return dict(keys.topic('ros_type' if is_polled else 'srv_type'), layout=request, reply=reply,
                period=keys['period'] if is_polled else 0.0, timeout=keys['timeout'] or None,
                repeatable=is_polled or keys['repeatable'], interrupts=keys['interrupts'])


def _setting(_group: Group, keys: '_Keys') -> Dict[str, Any]:
    code = keys.get('layout', _text('<[?bBhHiIf]'), '< and one of ? b B h H i I f')[1:]
    keys.refuse_others((*_SETTING_KEYS, *(('minimum', 'maximum') if code != '?' else ())))
    is_float, (low, high) = code in FRACTIONS, Value('', code=code).range
    minimum, maximum = [(float if is_float else int)(keys.get(
        key, lambda n: _number(low, high)(n) and (is_float or n == int(n)),
        f'a {"" if is_float else "whole "}number from {low:.10g} to {high:.10g}', default))
        for key, default in (('minimum', low), ('maximum', high))]
    if minimum > maximum:
        raise keys.error('minimum', f'may be at most the maximum, {maximum:g}')
    value = Value(keys.key.rpartition('/')[2], keys['unit'])
    if is_float:     # NaN and infinity are implausible; what a float32 makes of a limit is allowed
        value = value._replace(minimum=low, maximum=high)
        minimum, maximum = min(minimum, shortest(minimum)), max(maximum, shortest(maximum))
    return dict(layout=Layout('<B' + code, [Value('number'), value]), minimum=minimum,
                maximum=maximum, unit=value.unit, description=' '.join(keys['description'].split()))


class _Keys:
    """Reads and checks the keys `given` of one row, whose own key is as ``arduino/messages/force``;
    every method raises RowError for a wrong value."""

    def __init__(self, key: str, given: Any) -> None:
        self.key = key
        self.given: Dict[str, Any] = given
        if not isinstance(given, dict):
            raise RowError(key, given, 'may be a group of keys')

    def refuse_others(self, keys: Sequence[str]) -> None:
        """Refuse keys that such a row does not have."""
        for unknown in self.given:
            if unknown not in keys:
                raise self.error(unknown, f'is not a key of such a row; {", ".join(keys)} are')

    def error(self, key: str, allowed: str) -> RowError:
        """That the value of a key is wrong."""
        return RowError(f'{self.key}/{key}', self.given.get(key), allowed)

    def get(self, key: str, may_be: Callable[[Any], bool], words: str, default: Any = None) -> Any:
        """The value of a key; without a default it is required."""
        if key not in self.given and default is not None:
            return default
        value = self.given.get(key)
        if not may_be(value):
            raise self.error(key, f'may be {words}')
        return value

    def __getitem__(self, key: str) -> Any:
        return self.get(key, *_CHECKS[key])

    def topic(self, type_key: str = 'ros_type') -> Dict[str, Any]:
        """The ROS type, the frames and the constants of the row's messages."""
        child = self['child_frame_id']
        if child and self['frame_id'] in ('', child):
            raise self.error('child_frame_id', 'needs a frame_id, of another frame')
        # One object for all NaN, which is equal to itself: rows are compared.
        constants = {path: [nan if each != each else each for each in value]
                     if type(value) is list else nan if value != value else value
                     for path, value in self['constants'].items()}
        return dict(ros_type=self[type_key], frame_id=self['frame_id'], child_frame_id=child,
                    constants=constants)

    def check_motion(self, layout: Layout) -> None:
        """Refuse a motion that cannot be stopped by a zero of a fixed length."""
        zero = [0] * len(layout.values)
        try:
            layout.pack(zero)
            why = layout.implausible(zero)
        except ValueError as error:
            why = str(error)
        if not all(value.kind == 'number' for value in layout.values):
            why = 'it may have numbers and bools alone, of a fixed length (else: motion: false)'
        if why:
            raise RowError(f'{self.key}/motion', True, f'has to allow the zero of a motion: {why}')

    def inner(self, key: str, longest: int, allowed: Sequence[str]) -> Layout:
        """The layout of the DATE of a request or a reply."""
        if key not in self.given:
            return EMPTY
        keys = _Keys(f'{self.key}/{key}', self.given[key])
        keys.refuse_others(allowed)
        return keys.layout(longest)

    def layout(self, longest: int, may_be_timed: bool = False) -> Layout:
        """The layout, of at most `longest` bytes of data; `may_be_timed`: with `BOARD_TIME`."""
        layout, paths = self['layout'], self.given.get('fields')
        if type(paths) is not list or not all(
                type(path) is str and (path == BOARD_TIME or _PATH.fullmatch(path))
                for path in paths):
            raise self.error('fields', 'may be a list with the path of a field for each value, '
                             'as [vector.x, "", position[2]]')
        try:
            codes = [(code, end) for code, _start, end in places_of(layout, longest)[2]]
        except ValueError as error:
            raise self.error('layout', 'may be a format of Python\'s struct, as <hB: '
                             f'{error}') from None
        count = len(codes)
        if len(paths) != count:
            raise self.error('fields', f'may be a list of {count}, one for each value of the '
                             f'layout {layout}')
        for path, (code, end) in zip(paths, codes):
            if path and paths.count(path) > 1:
                raise self.error('fields', f'may have {path} once')
            if path == BOARD_TIME and not (may_be_timed and code == 'I' and end > 0):
                raise self.error('fields', f'may have {BOARD_TIME} at an I of the layout, in a '
                                 'message from the board')
        scales = self._each('scale', count, 1, lambda n: _is_number(n) and 0 != abs(n) < _HUGE,
                            'a number but 0')
        offsets = self._each('offset', count, 0, lambda n: _is_number(n) and abs(n) < _HUGE)
        minima, maxima = self._each('minimum', count, -inf), self._each('maximum', count, inf)
        for minimum, maximum in zip(minima, maxima):
            if minimum > maximum:
                raise self.error('minimum', f'may be at most the maximum, {maximum:g}')
        return Layout(layout, self._with_invalid([
            Value(path, 'us', code=code) if path == BOARD_TIME else
            Value(path, '', scale, offset, minimum, maximum, code=code)
            for path, (code, _end), scale, offset, minimum, maximum in zip(
                paths, codes, scales, offsets, minima, maxima)]))

    def _each(self, key: str, count: int, default: Any,
              may_be: Callable[[Any], bool] = lambda n: _is_number(n),
              allowed: str = 'a number') -> List[Any]:
        """A number for each value, from a list or from one number for all."""
        given = self.given.get(key, default)
        numbers = given if type(given) is list else [given] * count
        if len(numbers) != count or not all(map(may_be, numbers)):
            raise self.error(key, f'may be {allowed}, or a list of {count}')
        return numbers

    def _with_invalid(self, values: List[Value]) -> List[Value]:
        """The values with their raw numbers that mean "no value".

        A list has to fit all values; one number for all has to fit one of them.
        """
        invalid = self._each('invalid', len(values), '', lambda n: n == '' or _is_number(n),
                             'a number, or an empty text for none')
        fits = [number == '' or value.name != BOARD_TIME and value.holds(number)
                for value, number in zip(values, invalid)]
        if not all(fits) and (type(self.given['invalid']) is list or not any(fits)):
            raise self.error('invalid', 'may be a raw number that its place '
                             f'({values[fits.index(False)].code}) can hold exactly')
        return [value._replace(invalid=number) if fit and number != '' else value
                for value, number, fit in zip(values, invalid, fits)]


def _is_number(value: Any) -> bool:
    """Whether it is a number that a float can represent, and not NaN."""
    try:
        return type(value) in (int, float) and not isnan(value)
    except OverflowError:
        return False
