"""The forms of the page: one for each service, setting and command of the boards."""
import io
import math
import struct
from contextlib import suppress
from typing import Any, Dict, Iterable, List, NamedTuple, Tuple

import genpy
import roslib.message

from ...boards.description import Description, Field
from ...framing.layout import Value
from ...framing.rows import Kind, RowError
from ...ros.fields import outcome_fields
from ...ros.rows import RosRow, read_rows, resolve
from ...ros.settings import Reconfigure, request_of, value_in
from ..watch.topics import given_rows, leaves, one_line
from .driving import CommandRefused

_MOST_REPLY = 40            # fields of a response that are shown
_MOST_TEXT = 200            # characters of each
_HUGE = 1e30                # a limit beyond is that of a float, and none for people


class Form(NamedTuple):
    """A command that the page offers. The name of a form is that of its service, setting or topic,
    relative to the node."""

    link: str           # that it needs
    ros_class: Any      # of the service, or of the message
    fields: List[Dict[str, Any]]     # see `_field`
    service: str = ''   # its name; '': a message is published, which has no answer
    row: Any = None     # RosRow; None: the fields are those of the request
    setting: Any = None     # the row of the setting that it sets
    moves: bool = False     # its zero has to follow, since it moves something
    title: str = ''
    confirm: str = ''   # what to tell before it is called; '': nothing

    def described(self) -> Dict[str, Any]:
        """What the page needs to build it."""
        return {'link': self.link, 'fields': self.fields, 'title': self.title,
                'type': self.ros_class._type, 'motion': self.moves, 'confirm': self.confirm,
                'isCall': bool(self.service),
                'setting': self.setting.name if self.setting else '',
                'about': self.row.row.description if self.row else ''}

    def make(self, given: Dict[str, Any]) -> Any:
        """The request or message with these values by field; CommandRefused if they do not fit."""
        names = [field['name'] for field in self.fields]
        if sorted(given) != sorted(names):
            raise CommandRefused(f'it takes {", ".join(names) or "nothing"}')
        try:
            made = request_of(self.setting, given['value']) if self.setting else \
                _filled(self.row, given) if self.row else self.ros_class._request_class(**given)
            made.serialize(io.BytesIO())     # finds what its type cannot hold
        except (ArithmeticError, TypeError, ValueError, struct.error,
                genpy.SerializationError) as error:
            raise CommandRefused(str(error)) from None
        return made

    def reply(self, response: Any) -> List[Tuple[str, str]]:
        """The fields of a response that an outcome does not fill: name and value as text."""
        if self.setting:
            return [(self.setting.name, str(value_in(response, self.setting)))]
        known = outcome_fields(type(response))
        found = [leaf for name in response.__slots__ if name not in known
                 for leaf in leaves(name, getattr(response, name))]
        return [(each.name, one_line(each.text())[:_MOST_TEXT]) for each in found[:_MOST_REPLY]]


def _filled(row: RosRow, given: Dict[str, Any]) -> Any:
    """The message or request of a row with these values; ValueError if they are out of range."""
    layout, fields = row.row.layout, row.request or row.fields
    values = [tuple(each) if isinstance(each, list) else each for each in (
        given[value.name] if value.name else 0 for value in layout.values)]
    reason = layout.implausible(values)
    if reason:
        raise ValueError(reason)
    layout.pack(values)
    return fields.fill(fields.new(), values)


def forms(boards: Iterable[Description], parameters: Any) -> Dict[str, Form]:
    """The forms of these boards, by name; a row with which no bridge would start has none."""
    found: Dict[str, Form] = {}
    for board in boards:
        rows = [resolve(board, row) for row in board.rows]
        for group, name, given in given_rows(board, parameters):
            with suppress(RowError):
                rows += read_rows(board, group.parameter, {name: given})
        found.update((each.name, _form(board, each)) for each in rows
                     if each.row.kind is not Kind.FROM and not each.row.period)
        for service in board.services:
            service_class = roslib.message.get_service_class(service.type)
            if service_class:
                row = found[service.name].row if service.name in found else None
                known = {field.name: field for field in service.fields}
                values = row.row.layout.values if row else [
                    Value(name) for name in service_class._request_class.__slots__]
                found[service.name] = Form(board.name, service_class, [
                    _field(value, known.get(value.name, Field(''))) for value in values],
                    service.name, row, title=service.title, confirm=service.confirm)
    return found


def _form(board: Description, row: RosRow) -> Form:
    setting: Any = row.row
    if setting.kind is not Kind.SETTING:
        return Form(board.name, row.ros_class, [
            _field(value) for value in row.row.layout.values if value.name],
            row.name if setting.kind is Kind.FUNCTION else '', row, moves=setting.motion)
    value = setting.layout.values[1]._replace(minimum=setting.minimum, maximum=setting.maximum)
    return Form(board.name, Reconfigure, [{**_field(value), 'name': 'value'}],
                f'~settings/{board.name}/set_parameters', row, setting,
                title=f'{board.name}: {setting.name}')


def _field(value: Value, known: Field = Field('')) -> Dict[str, Any]:
    """A field of a form, with what the board's description has of it."""
    least, most = value.range if value.code else (-math.inf, math.inf)
    low, high = max(least, value.minimum, known.minimum), min(most, value.maximum, known.maximum)
    return {'name': value.name, 'kind': 'bool' if value.code == '?' else value.kind,
            'whole': bool(value.code) and value.is_whole, 'unit': known.unit or value.unit,
            'low': low if abs(low) < _HUGE else None, 'high': high if abs(high) < _HUGE else None,
            'preset': known.preset, 'choices': known.choices}
