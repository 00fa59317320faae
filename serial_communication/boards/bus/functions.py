"""Custom functions of the bus: ``bus/functions``, one row for each.

config/custom_messages.yaml shows their keys. The names of ROS types are plain text here.
"""
from typing import Any, List

from ...framing.custom_messages import LAYOUT_KEYS, ROS_TYPE, Row, RowError, rows
from ...framing.layout import Layout
from .messages import ANNOUNCEMENT, BUILT_IN, FUNCTION, NO_DATA, Function
from .wire import MAX_LENGTH

_KEYS = ('cmd2', 'srv_type', 'ros_type', 'period', 'frame_id', 'child_frame_id', 'constants',
         'request', 'reply', 'timeout', 'repeatable', 'interrupts')
_TAKEN = [str(cmd2) for cmd1, cmd2 in sorted(BUILT_IN) if cmd1 == FUNCTION
          and cmd2 < ANNOUNCEMENT.cmd2]
_FREE = (f'a whole number from 0 to {ANNOUNCEMENT.cmd2 - 1} but {", ".join(_TAKEN[:-1])} '
         f'and {_TAKEN[-1]}')


def read_functions(entries: Any, key: str = 'bus/functions') -> List[Function]:
    """The custom functions in the parameter `key`; RowError for the first mistake in them."""
    functions: List[Function] = []
    for name, row in rows(entries, key, _KEYS):
        if ('srv_type' in row.given) == ('ros_type' in row.given):
            raise RowError(row.key, None if row.given else {}, 'has either srv_type or ros_type')
        cmd2 = row.number('cmd2', lambda n: 0 <= n < ANNOUNCEMENT.cmd2
                          and (FUNCTION, n) not in BUILT_IN, _FREE, whole=True)
        row.refuse_second('cmd2', cmd2, {other.cmd2: other.name for other in functions})
        polled = 'ros_type' in row.given
        if polled:
            row.refuse_unused(['repeatable', 'interrupts'], 'ros_type')
        else:
            row.refuse_unused(['period', 'frame_id', 'child_frame_id', 'constants'], 'srv_type')
        functions.append(Function(
            name, cmd2, key=row.key,
            request=_layout(row, 'request', only_zeros=polled), reply=_layout(row, 'reply'),
            service='' if polled else '~' + name,
            srv_type=row.text('srv_type', ROS_TYPE, 'a service type, as std_srvs/Trigger', ''),
            ros_type=row.text('ros_type', ROS_TYPE, 'a message type, as std_msgs/Float32', ''),
            period=row.number('period', lambda n: 0.001 <= n <= 86400,
                              'a number from 0.001 to 86400 (s)') if polled else 0.0,
            frame_id=row.text('frame_id', None, 'text', ''), constants=row.constants(),
            child_frame_id=row.child_frame_id(),
            timeout=row.number('timeout', lambda n: 0.01 <= n <= 600,
                               'a number from 0.01 to 600 (s)', default=0.0) or None,
            repeatable=polled or row.flag('repeatable'),
            interrupts=not polled and row.flag('interrupts')))
        if functions[-1].interrupts and not functions[-1].repeatable:
            raise RowError(row.name('repeatable'), False,
                           'has to be true where interrupts is true: it is sent more than once')
    return functions


def _layout(row: Row, key: str, only_zeros: bool = False) -> Layout:
    """The layout of the DATE of a request or a reply."""
    if key not in row.given:
        return NO_DATA
    inner = Row(row.name(key), row.given[key], LAYOUT_KEYS)
    layout, values = inner.layout(MAX_LENGTH)
    if key == 'request':
        inner.refuse_unused(['invalid'], 'a request, which is sent to the board')
    if only_zeros and any(value.name for value in values):
        raise RowError(inner.name('fields'), inner.given['fields'], 'may be empty texts only: '
                       'a polled request has no message to take values from')
    return Layout(layout, values)
