"""Custom functions of the bus: ``bus/functions``, one row for each.

config/custom_messages.yaml shows their keys. The names of ROS types are plain text here.
"""
from typing import Any, Dict, List, NamedTuple, Optional, Tuple

from ...framing import announcement
from ...framing.custom_messages import LAYOUT_KEYS, ROS_TYPE, Row, RowError, rows
from ...framing.layout import Layout, Value
from . import wire

_BUILT_IN = (wire.LIFT, wire.GIMBAL, wire.ENVIRONMENT)
_KEYS = ('cmd2', 'srv_type', 'ros_type', 'period', 'frame_id', 'constants', 'request', 'reply',
         'timeout', 'repeatable', 'interrupts')


class CustomFunction(NamedTuple):
    """A row of ``bus/functions``: a service (`srv_type`) or a polled topic (`ros_type`)."""

    name: str
    key: str               # its parameter, bus/functions/NAME
    cmd2: int
    request: Layout        # the request's DATE
    reply: Layout          # the OK's DATE
    srv_type: str          # '' for a polled topic
    ros_type: str          # '' for a service
    period: float          # s between two polls; 0 for a service
    frame_id: str
    constants: Dict[str, Any]    # see CustomMessage
    timeout: Optional[float]     # s; None: bus/reply_timeout
    repeatable: bool
    interrupts: bool       # a stop: sent at once, whatever is outstanding; it is repeatable

    @property
    def number(self) -> Tuple[str, int]:
        """The key of its number on the wire, and that number."""
        return 'cmd2', self.cmd2

    @property
    def layouts(self) -> Dict[str, Layout]:
        """The layouts of its request and its reply."""
        return {'Request': self.request, 'Reply': self.reply}

    @property
    def purpose(self) -> str:
        """What it is for, in a few words."""
        return f'a service: {self.srv_type}' if self.srv_type else f'polled: {self.ros_type}'

    def make_request(self, values: Tuple) -> wire.Request:
        """The request with these values.

        Raises:
            ValueError: a value does not fit the layout, or is out of its range.
        """
        reason = self.request.implausible(values)
        if reason:
            raise ValueError(reason)
        request = wire.NamedRequest(wire.FUNCTION, self.cmd2, self.request.pack(values))
        request.function = self
        request.text = f'{self.name} {self.request.text(values)}'.rstrip()
        return request

    def name_reply(self, reply: wire.Reply) -> wire.Reply:
        """The same reply, whose text has the function's name if it is an OK with fitting data."""
        if reply.cmd1 != wire.OK or not self.reply.fits(len(reply.data)):
            return reply
        named = wire.NamedReply(*reply)
        named.text = f'{self.name} OK {self.reply.text(self.reply.unpack(reply.data))}'.rstrip()
        return named


# Asks for one chunk of the board's announcement.
ANNOUNCEMENT = CustomFunction(
    name='announcement', key='bus/announcements', cmd2=announcement.TYPE,
    request=Layout('<B', [Value('index')]), reply=announcement.Chunk.LAYOUT, srv_type='',
    ros_type='', period=0.0, frame_id='', constants={}, timeout=None, repeatable=True,
    interrupts=False)


def read_functions(entries: Any, key: str = 'bus/functions') -> List[CustomFunction]:
    """The custom functions in ``bus/functions``.

    Raises:
        RowError: for the first mistake in them.
    """
    functions: List[CustomFunction] = []
    for name, row in rows(entries, key, _KEYS):
        if ('srv_type' in row.given) == ('ros_type' in row.given):
            raise RowError(row.key, None if row.given else {}, 'has either srv_type or ros_type')
        cmd2 = row.number('cmd2', lambda n: n not in _BUILT_IN and 0 <= n <= 254,
                          'a whole number from 0 to 254 but 32, 33 and 34', whole=True)
        row.refuse_second('cmd2', cmd2, {other.cmd2: other.name for other in functions})
        polled = 'ros_type' in row.given
        if polled:
            row.refuse_unused(['repeatable', 'interrupts'], 'ros_type')
        else:
            row.refuse_unused(['period', 'frame_id', 'constants'], 'srv_type')
        functions.append(CustomFunction(
            name, row.key, cmd2, _layout(row, 'request', only_zeros=polled), _layout(row, 'reply'),
            row.text('srv_type', ROS_TYPE, 'a service type, as std_srvs/Trigger', ''),
            row.text('ros_type', ROS_TYPE, 'a message type, as std_msgs/Float32', ''),
            row.number('period', lambda n: 0.001 <= n <= 86400, 'a number from 0.001 to 86400 (s)')
            if polled else 0.0,
            row.text('frame_id', None, 'text', ''), row.constants(),
            row.number('timeout', lambda n: 0.01 <= n <= 600, 'a number from 0.01 to 600 (s)',
                       default=0.0) or None,
            polled or row.flag('repeatable'), not polled and row.flag('interrupts')))
        if functions[-1].interrupts and not functions[-1].repeatable:
            raise RowError(row.name('repeatable'), False,
                           'has to be true where interrupts is true: it is sent more than once')
    return functions


def _layout(row: Row, key: str, only_zeros: bool = False) -> Layout:
    """The layout of the DATE of a request or a reply."""
    if key not in row.given:
        return wire.NO_DATA
    inner = Row(row.name(key), row.given[key], LAYOUT_KEYS)
    layout, values = inner.layout(wire.MAX_LENGTH)
    if key == 'request':
        inner.refuse_unused(['invalid'], 'a request, which is sent to the board')
    if only_zeros and any(value.name for value in values):
        raise RowError(inner.name('fields'), inner.given['fields'], 'may be empty texts only: '
                       'a polled request has no message to take values from')
    return Layout(layout, values)
