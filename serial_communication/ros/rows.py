"""Rows with their ROS types and fields.

These are resolved while the parameters are checked. So a mistake in a row ends the node before it
has registered anything or opened a port.
"""
from dataclasses import replace
from typing import Any, Dict, List, NamedTuple

from ..boards.description import Description
from ..framing.rows import Kind, Row, RowError
from .fields import RosFields, find_type

ODOMETRY = 'nav_msgs/Odometry'


class RosRow(NamedTuple):
    """A row in ROS; its layouts have the limits of the ROS fields, too."""

    row: Row
    name: str                       # of the topic, service or parameter, relative to the node
    ros_class: Any = None           # of the messages or the service; None: of a setting
    fields: Any = None              # RosFields of the message, or of the service's response
    request: Any = None             # RosFields of a service's request
    stop: Any = None                # of a function that interrupts: what ~stop requests, all 0


def read_rows(board: Description, parameter: str, given: Any) -> List[RosRow]:
    """The rows in one of a board's parameters; RowError for the first mistake."""
    return [resolve(board, row) for row in board.read(parameter, given)]


def rows_in(parameters: Dict[str, Any]) -> List[RosRow]:
    """All rows in the checked parameters of a board."""
    return [each for value in parameters.values() if isinstance(value, list)
            for each in value if isinstance(each, RosRow)]


def resolve(board: Description, row: Row) -> RosRow:
    """A row with its ROS types; RowError for a mistake."""
    name, key = board.name_of(row), row.key
    if row.kind is Kind.SETTING:
        return RosRow(row, name)
    if row.kind is Kind.FUNCTION and not row.period:
        return _service(row, name)
    found = find_type(f'{key}/ros_type', row.ros_type)
    _check_frame_ids(row, found)
    layout, paths = (row.reply, 'reply/fields') if row.kind is Kind.FUNCTION else \
        (row.layout, 'fields')
    fields = RosFields(found, layout, f'{key}/{paths}', row.constants, f'{key}/constants')
    if row.kind is Kind.FUNCTION:
        row = replace(row, reply=fields.layout)
    elif row.kind is Kind.FROM and row.key:
        row.message.LAYOUT = fields.layout     # the class is of this row alone
    return RosRow(row, name, found, fields)


def _service(row: Any, name: str) -> RosRow:
    key, stop = row.key, None
    found = find_type(f'{key}/srv_type', row.ros_type, 'srv')
    request = RosFields(found._request_class, row.layout, f'{key}/request/fields')
    reply = RosFields(found._response_class, row.reply, f'{key}/reply/fields')
    for value in map(row.reply.values.__getitem__, reply.without_nan):
        raise RowError(f'{key}/reply/invalid', value.invalid, f'needs a float field, but '
                       f'{value.name} is none, and a response cannot be left out')
    if row.interrupts:
        try:
            stop = row.make_request(request.read(found._request_class()))
        except ValueError as error:
            raise RowError(f'{key}/interrupts', True, 'needs a request that allows 0 in every '
                           f'field: {error}') from None
    return RosRow(replace(row, reply=reply.layout), name, found, reply, request, stop)


def _check_frame_ids(row: Row, found: Any) -> None:
    """Raise RowError if a row has a frame id, but its ROS type has no field for it."""
    if row.frame_id and not found._has_header:
        raise RowError(f'{row.key}/frame_id', row.frame_id,
                       f'needs a type with a header, {found._type} has none')
    if row.child_frame_id and 'child_frame_id' not in found.__slots__:
        raise RowError(f'{row.key}/child_frame_id', row.child_frame_id,
                       f'needs a type with child_frame_id, as {ODOMETRY}; {found._type} has none')
