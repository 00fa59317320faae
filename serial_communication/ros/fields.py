"""Converts values to and from the fields of any ROS message, by paths such as ``position[2]``.

Creating a `RosFields` checks the paths completely.
"""
import os
import re
import sys
from contextlib import suppress
from copy import deepcopy
from io import BytesIO
from typing import Any, Callable, Dict, List, NamedTuple, Optional, Sequence, Tuple, Union

import roslib.message
import rospy
from genpy import Message, SerializationError

from ..framing.layout import BOARD_TIME, FINITE, FRACTIONS, NO_VALUE, Layout, Value
from ..framing.rotation import angles, quaternion
from ..framing.rows import RowError
from ..link.outcome import Outcome

_ANGLE = 'angle'     # the type of a further field of a quaternion, in radians
_ANGLES = 'roll', 'pitch', 'yaw'
# Struct's codes of the types of numbers.
_CODES = {'bool': FINITE, _ANGLE: FINITE, 'int8': 'b', 'byte': 'b', 'uint8': 'B', 'char': 'B',
          'int16': 'h', 'uint16': 'H', 'int32': 'i', 'uint32': 'I', 'int64': 'q', 'uint64': 'Q',
          'float32': 'f', 'float64': 'd'}
_MOST_ELEMENTS = 1000     # of an array whose elements are named singly, such as position[2]
_QUATERNION = 'geometry_msgs/Quaternion'
# Of the fields of a response that an outcome fills, where it has them.
_OUTCOME_TYPES = {'success': ('bool',), 'status': ('uint8', 'uint16', 'uint32', 'int16', 'int32'),
                  'error_code': ('uint16', 'uint32', 'int32'), 'message': ('string',)}
_STEP = re.compile(r'([A-Za-z]\w*)(?:\[(\d+)\])?')


def find_type(key: str, name: str, kind: str = 'msg') -> Any:
    """Return the class of an installed message (``kind`` 'msg') or service ('srv') type.

    Only a generated module is imported: a board may announce any name, and importing any other
    module might do anything.

    Raises:
        RowError: the type is not installed.
    """
    package, short = name.split('/')
    path = os.path.join(package, kind, f'_{short}.py')
    find = roslib.message.get_service_class if kind == 'srv' else roslib.message.get_message_class
    found = None
    with suppress(Exception, SystemExit):     # the module of that name may be anything
        found = any(os.path.exists(os.path.join(each, path)) for each in sys.path) and find(name)
    if not found:
        raise RowError(key, name, 'is not an installed type: is its package installed, and the '
                       'workspace of that package sourced?')
    return found


class _Place(NamedTuple):
    """The field or array element that holds one value."""

    owner: Tuple[Union[str, int], ...]     # path to the message or array that has it
    last: Union[str, int]                  # its field name or index there
    type: str                              # of ROS
    array: str                             # '[3]', '[]', or '' if it is none
    to_ros: Optional[Callable[[Any], Any]] = None     # converts the value

    @property
    def code(self) -> str:
        """Struct's code of its number, or `FINITE`; '' for a text."""
        return _CODES.get(self.type, '')

    def whole(self, given: Any) -> Any:
        """A constant for it; of a list that is the diagonal of a matrix, the matrix."""
        size = int(self.array[1:-1] or 0) if self.array else 0
        if not isinstance(given, list) or len(given) ** 2 != size:
            return given
        matrix = [0.0] * size
        matrix[::len(given) + 1] = given
        return matrix

    def get(self, message: Any) -> Any:
        """Read the value in the message; IndexError if its array is too short."""
        owner = _walk(message, self.owner)
        if self.type == _ANGLE:
            return angles(owner.x, owner.y, owner.z, owner.w)[_ANGLES.index(self.last)]
        value = _walk(owner, (self.last,))
        return tuple(value) if isinstance(value, (list, bytes)) else value

    def put(self, message: Any, value: Any) -> None:
        """Write a value into the message."""
        holder = _walk(message, self.owner)
        if isinstance(self.last, int):
            holder[self.last] = value
        else:
            setattr(holder, self.last, value)


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
        self._message = message_class()     # with the constants, and arrays long enough
        if any(value.name == BOARD_TIME for value in layout.values) \
                and not message_class._has_header:
            raise RowError(key, BOARD_TIME, f'needs a type with a header, {message_class._type} '
                           'has none')
        self._places = [None if value.name in ('', BOARD_TIME) else self._place(key, value)
                        for value in layout.values]
        for path, given in (constants or {}).items():
            constant = self._follow(constants_key, path)
            try:
                constant.put(self._message, constant.whole(given))
                self._message.serialize(BytesIO())
            except (SerializationError, AttributeError, OverflowError, ValueError) as error:
                raise RowError(f'{constants_key}/{path}', given,
                               f'cannot be there: {error}') from None
        # By the path to a quaternion: the indices of the values that are its angles.
        self._angles: Dict[Tuple, Dict[Union[str, int], int]] = {}
        for index, place in enumerate(self._places):
            if place and place.type == _ANGLE:
                self._angles.setdefault(place.owner, {})[place.last] = index
        # The values that may be "no value", in fields that cannot be NaN.
        self.without_nan = [
            index for index, (value, place) in enumerate(zip(layout.values, self._places))
            if place and value.invalid is not None
            and place.code not in FRACTIONS and place.type != _ANGLE]
        # The layout; there, a value that its field cannot hold is implausible.
        self.layout = Layout(layout.layout, layout.values,
                             ['' if place is None else place.code for place in self._places])

    def new(self) -> Any:
        """Return a message that has the constants, and arrays long enough for all values."""
        return deepcopy(self._message)

    def lacks(self, values: Sequence) -> bool:
        """Return whether one of the values is "no value" and its field cannot be NaN."""
        return any(values[index] is NO_VALUE or isinstance(values[index], tuple)
                   and NO_VALUE in values[index] for index in self.without_nan)

    def fill(self, message: Any, values: Sequence) -> Any:
        """Write the values into a message from `new`, and return it."""
        for place, value in zip(self._places, values):
            if place and place.type != _ANGLE:
                place.put(message, place.to_ros(value) if place.to_ros else value)
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
        try:
            return tuple([place.get(message) if place else 0 for place in self._places])
        except IndexError:
            raise ValueError('one of its arrays is too short') from None

    def _place(self, key: str, value: Value) -> _Place:
        """Return the place of a value; raise RowError if there is none that can hold it."""
        place, has = self._follow(key, value.name), value.kind
        fits = {'text': place.type == 'string' and not place.array,
                'array': place.type in _CODES and place.array == '[]',
                'number': place.type in _CODES and not place.array}
        if not fits[has]:
            raise RowError(key, value.name,
                           f'is {place.type}{place.array}, which cannot hold the {has} there')
        convert: Any = None
        if place.type == 'bool':
            convert = bool
        elif has != 'text' and place.code not in FRACTIONS and not value.is_whole:
            convert = round
        if convert and has == 'array':
            return place._replace(to_ros=lambda numbers: [convert(number) for number in numbers])
        return place._replace(to_ros=convert)

    def _follow(self, key: str, path: str) -> _Place:
        """Return the place at a path, which is in the message from now on; RowError if there can be
        none."""
        there, type_, array = self._message, '', ''
        steps: Tuple[Union[str, int], ...] = ()
        for name, element in _STEP.findall(path):
            owner = there
            fields = dict(zip(owner.__slots__, owner._slot_types)) \
                if isinstance(owner, Message) else {}
            if fields and owner._type == _QUATERNION:
                fields.update(dict.fromkeys(_ANGLES, _ANGLE))
            if name not in fields:
                raise RowError(key, path, f'has no field {name} there, but '
                               f'{", ".join(fields) or f"a single {type_}"}')
            type_, bracket, size = fields[name].partition('[')
            array = bracket + size
            there = None if type_ == _ANGLE else getattr(owner, name)
            steps += (name,)
            if element:
                most = int(array[1:-1] or _MOST_ELEMENTS) if array else 0
                if int(element) >= most:
                    raise RowError(key, path, f'{name} has elements 0 to {most - 1}' if array else
                                   f'{name} is not an array')
                make = roslib.message.get_message_class(type_) if '/' in type_ else \
                    {'string': str, 'bool': bool}.get(type_, int)
                items = [*there, *(make() for _ in range(int(element) + 1 - len(there)))]
                setattr(owner, name, items)
                there, array = items[int(element)], ''
                steps += (int(element),)
        return _Place(steps[:-1], steps[-1], type_, array)


def _walk(message: Any, steps: Sequence) -> Any:
    for step in steps:
        message = message[step] if isinstance(step, int) else getattr(message, step)
    return message


def outcome_fields(response_class: Any) -> List[str]:
    """Return the names of the fields of a response that an outcome fills."""
    types = dict(zip(response_class.__slots__, response_class._slot_types))
    return [name for name, fitting in _OUTCOME_TYPES.items() if types.get(name) in fitting]


def fill_response(response: Any, outcome: Outcome) -> Any:
    """Write an outcome into a response, and return the response; rospy.ServiceException if the call
    failed and the response has no field `success`."""
    names = outcome_fields(type(response))
    if not outcome.success and 'success' not in names:
        raise rospy.ServiceException(outcome.message)
    for name in names:
        setattr(response, name, getattr(outcome, name))
    return response
