"""Topics and services of messages that are rows, the package's own simple ones and the users'.

What rows of parameters have of ROS is resolved as the parameters are checked, so that every
mistake in them ends the node before it has registered anything or opened a port.
"""
from typing import Any, List, NamedTuple, Set, Tuple

import rospy

from ..boards import BOARDS, description
from ..boards.description import Description
from ..framing.custom_messages import CustomMessage, RowError
from .commands import CommandTopic
from .fields import RosFields, find_type
from .publishing import publisher, wanted

# Services that every node has.
_NODE_NAMES = {'get_loggers', 'set_logger_level'}
_LABEL = 100     # characters of a command's values in a warning


class RowMessage(NamedTuple):
    """A message of one's own, and what it is in ROS."""

    own: CustomMessage
    kind: Any             # its class, which takes for implausible what a field cannot hold
    message_class: Any    # of ROS
    fields: RosFields


def message_rows(board: Description, given: Any) -> List[RowMessage]:
    """What the parameter with a board's custom messages is; RowError for the first mistake."""
    return [_row_message(own, board.custom.prefix) for own in board.custom.read(given)]


def names_of(rows: List[Any], prefix: str) -> List[Tuple[str, str]]:
    """The topics and services that rows make: (name, the parameter that makes it)."""
    return [(prefix + row.own.name, row.own.key) for row in rows]


def _row_message(own: CustomMessage, prefix: str) -> RowMessage:
    refuse_taken(own, prefix)
    found = find_type(f'{own.key}/ros_type', own.ros_type)
    check_frame_id(own, found)
    fields = RosFields(found, own.kind.LAYOUT, f'{own.key}/fields')
    kind = own.kind if own.is_command else type(own.name, (own.kind,), {
        '__slots__': (), 'LAYOUT': fields.narrowed(own.kind.LAYOUT)})
    return RowMessage(own, kind, found, fields)


def refuse_taken(own: Any, prefix: str) -> None:
    """RowError if a custom message's name with this prefix is that of a board's own topic."""
    if own.name in taken_names(prefix):
        raise RowError(own.key, own.name, 'may have a name that the bridge has not itself')


def taken_names(prefix: str) -> Set[str]:
    """The names with a prefix that our boards and every node have themselves."""
    names = set(_NODE_NAMES) if prefix == '~' else set()
    for board in map(description, BOARDS):
        names.update(name[len(prefix):].split('/')[0]
                     for name in (*(topic.name for topic in board.topics), *board.other_names)
                     if name.startswith(prefix))
    return names


def check_frame_id(own: Any, found: Any) -> None:
    """RowError if there is a frame id, and the type has no header for it."""
    if own.frame_id and not found._has_header:
        raise RowError(f'{own.key}/frame_id', own.frame_id,
                       f'needs a type with a header, which {found._type} has not')


class RowTopic:
    """Messages of one class, published on one topic while anybody subscribes."""

    def __init__(self, name: str, ros_class: Any, fields: RosFields, frame_id: str = '') -> None:
        self._topic = publisher(name, ros_class)
        self._fields = fields
        self._message = fields.new()
        self._has_header = ros_class._has_header
        if frame_id:
            self._message.header.frame_id = frame_id

    def publish(self, values: Tuple, stamp: rospy.Time) -> None:
        """A message of these values."""
        if wanted(self._topic):
            if self._has_header:
                self._message.header.stamp = stamp
            self._topic.publish(self._fields.fill(self._message, values))


def built_in_topic(name: str, ros_class: Any, kind: Any) -> RowTopic:
    """The topic of a message of the package's own, whose fields have the names of its values."""
    return RowTopic(name, ros_class, RosFields(ros_class, kind.LAYOUT, name))


def own_topics(rows: List[RowMessage], prefix: str, frame_prefix: str) -> dict:
    """The topics of one's own messages from the board, by their classes."""
    return {row.kind: RowTopic(prefix + row.own.name, row.message_class, row.fields,
                               row.own.frame_id and frame_prefix + row.own.frame_id)
            for row in rows if not row.own.is_command}


def take_commands(rows: List[RowMessage], prefix: str, link: Any, age_limit: float) -> None:
    """Subscribe to one's own commands; what cannot be sent is refused with a warning."""
    for row in rows:
        if row.own.is_command:
            _take_command(row, prefix, link, age_limit)


def _take_command(row: RowMessage, prefix: str, link: Any, age_limit: float) -> None:
    def read(message: Any) -> Any:
        return row.kind(*row.fields.read(message))

    CommandTopic(prefix + row.own.name, row.message_class,
                 lambda message: link.command(read(message)),
                 lambda message: str(read(message))[:_LABEL], link.log, age_limit)
