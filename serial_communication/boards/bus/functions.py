"""Custom functions of the bus: ``bus/functions``, one entry each by name.

config/custom_messages.yaml shows their keys. Whatever they have of ROS is text here.
"""
from typing import Any, List, NamedTuple, Optional, Tuple

from ...framing.custom_messages import LAYOUT_KEYS, ROS_TYPE, Row, RowError, rows
from ...framing.layout import Layout
from . import wire

_BUILT_IN = (wire.LIFT, wire.GIMBAL, wire.ENVIRONMENT)
_KEYS = ('cmd2', 'srv_type', 'ros_type', 'period', 'frame_id', 'request', 'reply', 'timeout',
         'repeatable')


class CustomFunction(NamedTuple):
    """An entry of ``bus/functions``."""

    name: str
    key: str
    cmd2: int
    request: Layout        # of the DATE
    reply: Layout
    srv_type: str          # called; or else:
    ros_type: str          # asked every `period` s
    period: float
    frame_id: str
    timeout: Optional[float]
    repeatable: bool

    def ask(self, values: Tuple) -> wire.Request:
        """The request; ValueError for a value that its place cannot hold, or beyond a limit."""
        reason = self.request.implausible(values)
        if reason:
            raise ValueError(reason)
        request = wire.NamedRequest(wire.FUNCTION, self.cmd2, self.request.pack(values))
        request.function = self
        request.text = f'{self.name} {self.request.text(values)}'.rstrip()
        return request

    def answer(self, reply: wire.Reply) -> wire.Reply:
        """A reply to it, which says so if it is an OK with the right data."""
        if reply.cmd1 != wire.OK or not self.reply.fits(len(reply.data)):
            return reply
        named = wire.NamedReply(*reply)
        named.text = f'{self.name} OK {self.reply.text(self.reply.unpack(reply.data))}'.rstrip()
        return named


def read_functions(entries: Any, key: str = 'bus/functions') -> List[CustomFunction]:
    """The functions of ``bus/functions``; RowError for the first mistake in them."""
    functions: List[CustomFunction] = []
    for name, row in rows(entries, key, _KEYS):
        if ('srv_type' in row.given) == ('ros_type' in row.given):
            raise RowError(row.key, None if row.given else {}, 'has either srv_type or ros_type')
        cmd2 = row.number('cmd2', lambda n: n not in _BUILT_IN and 0 <= n <= 255,
                          'a whole number from 0 to 255 but 32, 33 and 34', whole=True)
        row.refuse_second('cmd2', cmd2, {other.cmd2: other.name for other in functions})
        polled = 'ros_type' in row.given
        for unfit in ('srv_type', 'repeatable') if polled else ('period', 'frame_id'):
            if unfit in row.given:
                raise RowError(row.name(unfit), row.given[unfit],
                               f'has no meaning beside {"ros_type" if polled else "srv_type"}')
        functions.append(CustomFunction(
            name, row.key, cmd2, _layout(row, 'request', only_zeros=polled), _layout(row, 'reply'),
            row.text('srv_type', ROS_TYPE, 'a service type, as std_srvs/Trigger', ''),
            row.text('ros_type', ROS_TYPE, 'a message type, as std_msgs/Float32', ''),
            row.number('period', lambda n: 0.001 <= n <= 86400, 'a number from 0.001 to 86400 (s)')
            if polled else 0.0,
            row.text('frame_id', None, 'text', ''),
            row.number('timeout', lambda n: 0.01 <= n <= 600, 'a number from 0.01 to 600 (s)',
                       default=0.0) or None,
            polled or row.flag('repeatable')))
    return functions


def _layout(row: Row, key: str, only_zeros: bool = False) -> Layout:
    """The layout of a request's or a reply's DATE."""
    if key not in row.given:
        return wire.NO_DATA
    inner = Row(row.name(key), row.given[key], LAYOUT_KEYS)
    layout, values = inner.layout(wire.MAX_LENGTH)
    if only_zeros and any(value.name for value in values):
        raise RowError(inner.name('fields'), inner.given['fields'], 'may be empty texts only: '
                       'there is no message to take the values of a polled request from')
    return Layout(layout, values)
