"""What the page needs for a form of each command: its fields, with their limits and units."""
import io
import math
import struct
from typing import Any, Dict, Iterable, List, NamedTuple, Optional, Tuple

import genpy
import roslib.message

from ...boards.description import Description, Field
from ...framing.layout import FRACTIONS, Value
from ...framing.row_reader import Group
from ...framing.rows import Kind, RowError, Setting
from ...ros.rows import RosRow, read_rows
from ...ros.settings import Reconfigure
from ..watch.topics import given_rows
from .dead_man import CommandRefused

_INTEGERS = {f'{sign}int{bits}': ((-(1 << bits - 1), (1 << bits - 1) - 1) if not sign
                                  else (0, (1 << bits) - 1))
             for sign in ('', 'u') for bits in (8, 16, 32, 64)}
_INTEGERS.update(byte=_INTEGERS['int8'], char=_INTEGERS['uint8'])
_OTHER_KINDS = {'bool': 'bool', 'string': 'text', 'float32': 'number', 'float64': 'number'}


class Service(NamedTuple):
    """A service that the page offers."""

    service_class: Any
    link: str                      # that it needs
    fields: List[Dict[str, Any]]   # of its request; see `_field`
    title: str = ''                # '': a custom function
    confirm: str = ''              # as in the board's description
    setting: Optional[Setting] = None    # that it sets; None: its fields are those of the request

    def service_name(self, name: str) -> str:
        """The name of the service; `name` is that of the form."""
        return f'~settings/{self.link}/set_parameters' if self.setting else name


class Message(NamedTuple):
    """A custom command: a row whose messages are sent to the board."""

    row: RosRow
    link: str
    fields: List[Dict[str, Any]]

    def make(self, given: Dict[str, Any]) -> Any:
        """The ROS message with these values; CommandRefused if they do not fit the row."""
        layout, name = self.row.row.layout, self.row.row.name
        names = [value.name for value in layout.values if value.name]
        if sorted(given) != sorted(names):
            raise CommandRefused(f'{name} takes {", ".join(names)}')
        values = [_number(given[value.name]) if value.name else 0 for value in layout.values]
        try:
            reason = layout.implausible(values)
            if reason:
                raise ValueError(reason)
            layout.pack(values)
            message = self.row.fields.fill(self.row.fields.new(), values)
            message.serialize(io.BytesIO())
        except (ArithmeticError, TypeError, ValueError, struct.error,
                genpy.SerializationError) as error:
            raise CommandRefused(f'{name}: {error}') from None
        return message


def _number(given: Any) -> Any:
    return tuple(given) if isinstance(given, list) else given


def board_services(boards: Iterable[Description]) -> Dict[str, Service]:
    """The services that the boards' descriptions have and whose types are installed here."""
    found = {}
    for board in boards:
        for each in board.services:
            service_class = roslib.message.get_service_class(each.type)
            if service_class:
                made = service(service_class, board.name)
                described = {field.name: field for field in each.fields}
                found[each.name] = made._replace(title=each.title, confirm=each.confirm, fields=[
                    _described(field, described.get(field['name'])) for field in made.fields])
    return found


def _described(field: Dict[str, Any], known: Optional[Field]) -> Dict[str, Any]:
    """The field of a form, with what the board's description has of it."""
    if known is None:
        return field
    limits = {'low': max(_or(field['low'], -math.inf), known.minimum),
              'high': min(_or(field['high'], math.inf), known.maximum)}
    return {**field, 'unit': known.unit, 'preset': known.preset, 'choices': known.choices,
            **{name: limit if math.isfinite(limit) else None for name, limit in limits.items()}}


def _or(limit: Optional[float], otherwise: float) -> float:
    return otherwise if limit is None else limit


def service(service_class: Any, link: str, values: Iterable[Value] = ()) -> Service:
    """A service with the fields of its type, whose limits a row's layout may narrow."""
    request, limits = service_class._request_class, {value.name: value for value in values}
    return Service(service_class, link, [
        _field(name, type_, limits.get(name))
        for name, type_ in zip(request.__slots__, request._slot_types)])


def custom_services(boards: Iterable[Description], parameters: Any) -> Dict[str, Service]:
    """The boards' custom functions that are services and whose types are installed here."""
    found = {}
    for board, group, name, row in _rows(boards, parameters):
        type_ = row.get('srv_type')
        service_class = roslib.message.get_service_class(type_) if isinstance(type_, str) else None
        if service_class:
            found[group.prefix + name] = service(
                service_class, board.name, _request_values(board, group, name, row))
    return found


def settings(boards: Iterable[Description], parameters: Any) -> Dict[str, Service]:
    """The boards' settings, by parameter."""
    found: Dict[str, Service] = {}
    for board, group, name, row in _rows(boards, parameters):
        if Kind.SETTING not in group.kinds:
            continue
        try:
            setting, = board.read(group.parameter, {name: row})
        except RowError:
            continue        # the bridge does not use it
        found[group.prefix + name] = Service(
            Reconfigure, board.name, [_setting_field(setting)], f'{board.name}: {name}',
            setting=setting)
    return found


def _setting_field(setting: Setting) -> Dict[str, Any]:
    value = setting.layout.values[1]
    field = _field('value', '', value._replace(minimum=setting.minimum, maximum=setting.maximum))
    # The limits of a float's place are none for people.
    return {**field, **{key: None for key, limit in zip(('low', 'high'), value.range)
                        if value.code in FRACTIONS and field[key] == limit}}


def custom_messages(boards: Iterable[Description], parameters: Any) -> Dict[str, Message]:
    """The boards' custom commands whose types are installed here."""
    found = {}
    for board, group, name, row in _rows(boards, parameters):
        if row.get('direction') != 'to_board':
            continue
        try:
            message, = read_rows(board, group.parameter, {name: row})
        except RowError:
            continue        # the bridge has not started with it
        found[message.name] = Message(message, board.name, [
            _field(value.name, '', value) for value in message.row.layout.values if value.name])
    return found


def _rows(boards: Iterable[Description], parameters: Any,
          ) -> Iterable[Tuple[Description, Group, str, Dict[str, Any]]]:
    return [(board, *found) for board in boards for found in given_rows(board, parameters)]


def _request_values(board: Description, group: Group, name: str,
                    row: Dict[str, Any]) -> Iterable[Value]:
    """The values of a function's request, by its row."""
    try:
        return board.read(group.parameter, {name: row})[0].layout.values
    except RowError:
        return ()


def _field(name: str, type_: str, value: Optional[Value]) -> Dict[str, Any]:
    """A field of a form.

    Args:
        type_: of ROS; empty if only the value is known.
        value: with the limits in the board's row; None: there is none.
    """
    low, high = _INTEGERS.get(type_, (-math.inf, math.inf))
    kind, whole, unit = _OTHER_KINDS.get(type_, 'number' if type_ in _INTEGERS else 'other'), \
        type_ in _INTEGERS, ''
    if value is not None:
        least, most = value.range
        low, high = max(low, least, value.minimum), min(high, most, value.maximum)
        unit, whole = value.unit, whole or value.is_whole
        kind = kind if type_ else 'bool' if value.code == '?' else value.kind
    return {'name': name, 'kind': kind, 'whole': whole, 'unit': unit,
            'low': low if math.isfinite(low) and kind != 'text' else None,
            'high': high if math.isfinite(high) and kind != 'text' else None}
