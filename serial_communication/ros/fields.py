"""Converts values to and from the fields of any ROS message, by paths such as ``position[2]``.

Creating a `RosFields` checks the paths completely.
"""
import os
import re
import struct
import sys
from math import isfinite, isinf, isqrt
from typing import (Any, Callable, Dict, Iterable, List, NamedTuple, Optional, Sequence, Tuple,
                    Union)

import roslib.message

from ..framing.rows import RowError
from ..framing.layout import BOARD_TIME, FRACTIONS, NO_VALUE, Layout, Value
from ..framing.rotation import angles, quaternion

_CODES = {'bool': '?', 'int8': 'b', 'byte': 'b', 'uint8': 'B', 'char': 'B', 'int16': 'h',
          'uint16': 'H', 'int32': 'i', 'uint32': 'I', 'int64': 'q', 'uint64': 'Q',
          'float32': 'f', 'float64': 'd'}      # struct's codes
_MOST_ELEMENTS = 1000     # of an array whose elements are named singly, such as position[2]
_QUATERNION = 'geometry_msgs/Quaternion'
_ANGLES = 'roll', 'pitch', 'yaw'     # further fields of a quaternion, in radians
_ANGLE = 'angle'     # in place of a code: any number but infinity
_STEP = re.compile(r'([A-Za-z]\w*)(?:\[(\d+)\])?')


def find_type(key: str, name: str, kind: str = 'msg') -> Any:
    """Return the class of an installed message (``kind`` 'msg') or service ('srv') type.

    Raises:
        RowError: the type is not installed.
    """
    found = _found(name, kind)
    if found is not None:
        return found
    raise RowError(key, name, 'is not an installed type: is its package installed, and the '
                   'workspace of that package sourced?')


def _found(name: str, kind: str) -> Any:
    """Return the class of a type, or None. Only a generated module is imported: a board may
    announce any name, and importing any other module might do anything."""
    package, short = name.split('/')
    if not any(os.path.exists(os.path.join(folder, package, kind, f'_{short}.py'))
               for folder in sys.path):
        return None
    find = roslib.message.get_message_class if kind == 'msg' else roslib.message.get_service_class
    try:
        found = find(name)
    except (Exception, SystemExit):  # pylint: disable=broad-except
        return None     # the module of that name may be anything
    return found if getattr(found, '_type', '') == name and (
        hasattr(found, '_slot_types') if kind == 'msg' else hasattr(found, '_request_class')
    ) else None


class _Place(NamedTuple):
    """The field or array element that holds one value."""

    owner: Tuple[Union[str, int], ...]     # path to the message or array that has it
    last: Union[str, int]                  # its field name or index there
    to_ros: Optional[Callable[[Any], Any]]     # converts the value
    code: str                              # struct's code of its number; '' for a string
    is_angle: bool = False                 # of a quaternion, which has no such field


class RosFields:
    """The mapping between the values of a layout and the fields of a ROS message type.

    Args:
        message_class: the ROS message type.
        layout: each value's name is its path; a value without a name is left out, and so is
            `BOARD_TIME`, which needs a type with a header.
        key: the parameter with the paths, for errors.
        constants: values by path; every message from `new` has them. A list is for an array; for
            one of n * n elements, a matrix, n values are its diagonal.
        constants_key: their parameter, for errors.

    Raises:
        RowError: a field does not exist, or cannot hold its value.
    """

    def __init__(self, message_class: Any, layout: Layout, key: str,
                 constants: Optional[Dict[str, Any]] = None, constants_key: str = '') -> None:
        self._class = message_class
        self._arrays: List[Tuple[Tuple, int, Any]] = []    # path, length and element in a message
        if any(value.name == BOARD_TIME for value in layout.values) \
                and not message_class._has_header:
            raise RowError(key, BOARD_TIME, f'needs a type with a header, {message_class._type} '
                           'has none')
        self._places = [self._resolve(key, value) if value.name not in ('', BOARD_TIME) else None
                        for value in layout.values]
        places = {value.name: place for value, place in zip(layout.values, self._places) if place}
        _refuse_shared(key, places)
        single: Dict[str, Any] = {}
        for path, value in (constants or {}).items():
            elements = self._elements(constants_key, path, value)
            for shared in single.keys() & elements:
                raise RowError(constants_key, shared, f'overlaps with {path}')
            single.update(elements)
        fixed = {path: self._constant(constants_key, path, value)
                 for path, value in single.items()}
        for path in places.keys() & fixed:
            raise RowError(constants_key, path, 'is in fields, too')
        _refuse_shared(constants_key, {**places, **fixed})
        self._constants = [(place, single[path]) for path, place in fixed.items()]
        # By the path to a quaternion: the indices of the values that are its angles.
        self._angles: Dict[Tuple, Dict[Union[str, int], int]] = {}
        for index, place in enumerate(self._places):
            if place and place.is_angle:
                self._angles.setdefault(place.owner, {})[place.last] = index
        # The values that may be "no value", in fields that cannot be NaN.
        self.without_nan = [
            index for index, (value, place) in enumerate(zip(layout.values, self._places))
            if place and value.invalid is not None and place.code not in FRACTIONS]

    def narrowed(self, layout: Layout) -> Layout:
        """Return the layout; there, a value that its field cannot hold is implausible."""
        codes = [_ANGLE if place and place.is_angle
                 else '' if not place or _holds_all(place.code, value) else place.code
                 for value, place in zip(layout.values, self._places)]
        return _NarrowedLayout(layout, codes) if any(codes) else layout

    def new(self) -> Any:
        """Return a message that has the constants, and arrays long enough for all values."""
        message = self._class()
        for steps, size, element in self._arrays:
            owner = _walk(message, steps[:-1])
            items = list(getattr(owner, steps[-1]))
            items += [element() for _ in range(size - len(items))]
            setattr(owner, steps[-1], items)
        for place, value in self._constants:
            _put(message, place, value)
        return message

    def lacks(self, values: Sequence) -> bool:
        """Return whether one of the values is "no value" and its field cannot be NaN."""
        return any(values[index] is NO_VALUE or isinstance(values[index], tuple)
                   and NO_VALUE in values[index] for index in self.without_nan)

    def fill(self, message: Any, values: Sequence) -> Any:
        """Write the values into a message from `new`, and return it."""
        for place, value in zip(self._places, values):
            if place and not place.is_angle:
                _put(message, place, place.to_ros(value) if place.to_ros else value)
        for owner, indices in self._angles.items():
            turn = _walk(message, owner)
            turn.x, turn.y, turn.z, turn.w = quaternion(*[
                values[indices[name]] if name in indices else 0.0 for name in _ANGLES])
        return message

    def read(self, message: Any) -> Tuple:
        """Return the values in a message.

        Raises:
            ValueError: one of its arrays is too short.
        """
        values = []
        for place in self._places:
            if place is None:
                values.append(0)
                continue
            try:
                owner = _walk(message, place.owner)
                value = angles(owner.x, owner.y, owner.z, owner.w)[_ANGLES.index(place.last)] \
                    if place.is_angle else _walk(owner, (place.last,))
            except IndexError:
                raise ValueError(f'{place.owner[-1]} has no element {place.last}') from None
            values.append(tuple(value) if isinstance(value, (list, bytes)) else value)
        return tuple(values)

    def _resolve(self, key: str, value: Value) -> _Place:
        """Return the place of a value; raise RowError if there is none that can hold it."""
        steps, type_, array, is_angle = self._follow(key, value.name)
        return self._checked(key, value, steps, type_, array)._replace(is_angle=is_angle)

    def _follow(self, key: str, path: str) -> Tuple[Tuple, str, str, bool]:
        """Return the steps of a path; the type at its end, and '[…]' if that is an array; and
        whether it is an angle of a quaternion."""
        message_class, type_, array, is_angle = self._class, '', '', False
        steps: Tuple[Union[str, int], ...] = ()
        for name, element in _STEP.findall(path):
            if message_class is None:
                raise RowError(key, path, f'must end at {steps[-1]}, a {type_} without fields')
            fields = dict(zip(message_class.__slots__, message_class._slot_types))
            if message_class._type == _QUATERNION:
                fields.update(dict.fromkeys(_ANGLES, 'float64'))
            if name not in fields:
                raise RowError(key, path, f'{message_class._type} has no field {name}; it has '
                               + ', '.join(fields))
            is_angle = name not in message_class.__slots__
            type_, bracket, size = fields[name].partition('[')
            array = bracket + size
            message_class = None if type_ in _CODES or type_ in ('string', 'time', 'duration') \
                else roslib.message.get_message_class(
                    'std_msgs/Header' if type_ == 'Header' else type_)
            steps += (name,)
            if element:
                if not array:
                    raise RowError(key, path, f'{name} is not an array')
                most = int(array[1:-1] or _MOST_ELEMENTS)
                if int(element) >= most:
                    raise RowError(key, path, f'{name} has elements 0 to {most - 1}')
                self._arrays.append((steps, int(element) + 1, message_class
                                     or {'string': str, 'bool': bool}.get(type_, int)))
                steps += (int(element),)
                array = ''
        return steps, type_, array, is_angle

    def _elements(self, key: str, path: str, given: Any) -> Dict[str, Any]:
        """Return the single constants, by path, that a constant means, which may be a list."""
        if not isinstance(given, list):
            return {path: given}
        _, type_, array, _ = self._follow(key, path)
        if not array:
            raise RowError(f'{key}/{path}', given, f'may be one value: {path} is no array')
        size, every = int(array[1:-1] or len(given)), 1
        if len(given) != size:
            every = isqrt(size) + 1      # from one element of the diagonal to the next
            if len(given) != every - 1 or len(given) ** 2 != size:
                square = f', or of {every - 1}, its diagonal' * ((every - 1) ** 2 == size)
                raise RowError(f'{key}/{path}', given, f'may be a list of {size}{square}: '
                               f'{path} is {type_}{array}')
        return {f'{path}[{index * every}]': value for index, value in enumerate(given)}

    def _constant(self, key: str, path: str, given: Any) -> _Place:
        """Return the place of a constant; raise RowError if it cannot hold it."""
        code = {bool: '?', int: 'q', float: 'd', str: 's'}[type(given)]
        place = self._resolve(key, Value(path, code=code))
        if path == 'header.frame_id':
            raise RowError(f'{key}/{path}', given, 'is set by the key frame_id')
        if place.is_angle:
            raise RowError(f'{key}/{path}', given, 'may be in fields only')
        if '?' in (place.code, code) and place.code != code:
            raise RowError(f'{key}/{path}', given, 'may be true or false' if place.code == '?'
                           else 'may be a number')
        if place.code and (place.to_ros is round or not _holds(place.code, given)):
            raise RowError(f'{key}/{path}', given, 'is a number that its ROS field cannot hold')
        return place

    @staticmethod
    def _checked(key: str, value: Value, steps: Tuple, type_: str, array: str) -> _Place:
        """Return the place if its type can hold the value; otherwise raise RowError."""
        path, has = value.name, value.kind
        why = ''
        if has == 'text' and (type_ != 'string' or array):
            why = '; a text needs a string'
        elif has != 'text' and type_ not in _CODES:
            why = ', which cannot hold a number'
        elif has == 'array' and array != '[]':
            why = '; the * in the layout needs an array of any length'
        elif has == 'number' and array:
            why = f'; a single number needs one element, such as {path}[0]'
        if why:
            raise RowError(key, path, f'is {type_}{array}{why}')
        convert: Optional[Callable[[Any], Any]] = None
        if type_ == 'bool':
            convert = bool
        elif has != 'text' and type_ not in ('float32', 'float64') and not value.is_whole:
            convert = round
        if convert and has == 'array':
            convert = _for_each(convert)
        return _Place(steps[:-1], steps[-1], convert, _CODES.get(type_, ''))


def _refuse_shared(key: str, places: Dict[str, _Place]) -> None:
    """Raise RowError if a value would overwrite another, as position does with position[0]."""
    taken = {(*place.owner, place.last): path for path, place in places.items()}
    for path, place in places.items():
        steps = (*place.owner, place.last)
        for end in range(1, len(steps) + 1):
            other = taken.get(steps[:end], path)
            if other != path:
                raise RowError(key, path, f'overlaps with {other}')
        for angle, turned in places.items():     # it sets all fields of its quaternion
            if turned.is_angle and place.owner == turned.owner and not place.is_angle:
                raise RowError(key, path, f'overlaps with {angle}')


class _NarrowedLayout(Layout):
    """A layout whose values must also fit the fields of a ROS message.

    Args:
        codes: struct's code of each value's field; '' if the field can hold every value.
    """

    def __init__(self, layout: Layout, codes: List[str]) -> None:
        super().__init__(layout.layout, layout.values)
        self._codes = codes

    def implausible(self, values: Sequence) -> str:
        return super().implausible(values) or next(
            (f'{value.name} is {number:.6g}, which its ROS field cannot hold'
             for given, value, code in zip(values, self.values, self._codes) if code
             for number in (given if isinstance(given, tuple) else (given,))
             if number is not NO_VALUE and not _holds(code, number)), '')


def _holds_all(code: str, value: Value) -> bool:
    """Return whether a field with struct's `code` ('' for a string) can hold every value."""
    return code in ('', 'd') or (code == 'f' or value.code not in FRACTIONS) and all(
        isfinite(end) and _holds(code, end) for end in value.range)


def _holds(code: str, number: float) -> bool:
    """Return whether a field with struct's `code`, or an angle, can hold a number, rounded for
    integers."""
    if code == _ANGLE:
        return not isinf(number)
    try:
        struct.pack('<' + code, number if code in FRACTIONS else round(number))
    except (struct.error, OverflowError, ValueError):
        return False
    return True


def _walk(message: Any, steps: Sequence) -> Any:
    for step in steps:
        message = message[step] if isinstance(step, int) else getattr(message, step)
    return message


def _put(message: Any, place: _Place, value: Any) -> None:
    holder = _walk(message, place.owner)
    if isinstance(place.last, int):
        holder[place.last] = value
    else:
        setattr(holder, place.last, value)


def _for_each(convert: Callable[[Any], Any]) -> Callable[[Iterable], list]:
    return lambda numbers: [convert(number) for number in numbers]
