"""Topics of custom messages, and of those built-in messages that need no code of their own.

The ROS types and fields in the rows are resolved while the parameters are checked. So a mistake in
a row ends the node before it has registered anything or opened a port.
"""
from typing import Any, Dict, List, NamedTuple, Sequence, Set, Tuple, Type

import rospy

from ..boards import BOARDS, description
from ..boards.description import Description
from ..framing.custom_messages import CustomMessage, RowError
from ..framing.layout import LayoutMessage
from .commands import CommandTopic
from .fields import RosFields, find_type
from .publishing import publisher, wanted

_NODE_SERVICES = {'get_loggers', 'set_logger_level'}    # every rospy node has them
_LABEL = 100     # characters of a command's values in a warning


class RosMessage(NamedTuple):
    """A custom message with its ROS type and fields."""

    custom: CustomMessage
    kind: Type[LayoutMessage]    # its message class, with the limits of the ROS fields, too
    message_class: Any           # of ROS
    fields: RosFields


def message_rows(board: Description, given: Any) -> List[RosMessage]:
    """Return the custom messages in a board's parameter `messages`.

    Raises:
        RowError: for the first mistake.
    """
    rows = board.custom
    return [_resolve(custom, rows.prefix) for custom in rows.read(given)] if rows else []


def names_of(rows: Sequence[Tuple], prefix: str) -> List[Tuple[str, str]]:
    """Return the topics and services that rows add: (name, the row's parameter).

    Args:
        rows: tuples that begin with a custom message or a custom function.
        prefix: of the names, such as ``~``.
    """
    return [(prefix + custom.name, custom.key) for custom, *_ in rows]


def _resolve(custom: CustomMessage, prefix: str) -> RosMessage:
    refuse_taken(custom, prefix)
    found = find_type(f'{custom.key}/ros_type', custom.ros_type)
    check_frame_id(custom, found)
    fields = RosFields(found, custom.kind.LAYOUT, f'{custom.key}/fields', custom.constants,
                       f'{custom.key}/constants')
    kind = custom.kind if custom.is_command else type(custom.name, (custom.kind,), {
        '__slots__': (), 'LAYOUT': fields.narrowed(custom.kind.LAYOUT)})
    return RosMessage(custom, kind, found, fields)


def refuse_taken(custom: Any, prefix: str) -> None:
    """Raise RowError if a row's name with this prefix is a name that the bridge uses."""
    if custom.name in taken_names(prefix):
        raise RowError(custom.key, custom.name, 'may not be a name that the bridge uses')


def taken_names(prefix: str) -> Set[str]:
    """Return the names, without this prefix, that the built-in boards and every node use."""
    names = set(_NODE_SERVICES) if prefix == '~' else set()
    for board in map(description, BOARDS):
        names.update(name[len(prefix):].split('/')[0]
                     for name in (*(topic.name for topic in board.topics), *board.other_names)
                     if name.startswith(prefix))
    return names


def check_frame_id(custom: Any, found: Any) -> None:
    """Raise RowError if a row has a frame id, but its ROS type has no header."""
    if custom.frame_id and not found._has_header:
        raise RowError(f'{custom.key}/frame_id', custom.frame_id,
                       f'needs a type with a header, {found._type} has none')


class ValuePublisher:
    """Publishes tuples of values as messages of one ROS type, while the topic has subscribers."""

    def __init__(self, name: str, ros_class: Any, fields: RosFields, frame_id: str = '') -> None:
        self._topic = publisher(name, ros_class)
        self._fields = fields
        self._message = fields.new()
        self._has_header = ros_class._has_header
        if frame_id:
            self._message.header.frame_id = frame_id

    def publish(self, values: Tuple, stamp: rospy.Time) -> None:
        """Publish a message with these values."""
        if wanted(self._topic):
            if self._has_header:
                self._message.header.stamp = stamp
            self._topic.publish(self._fields.fill(self._message, values))


def built_in_topic(name: str, ros_class: Any, kind: Type[LayoutMessage]) -> ValuePublisher:
    """Return the topic of a built-in message whose values have the names of the ROS fields."""
    return ValuePublisher(name, ros_class, RosFields(ros_class, kind.LAYOUT, name))


def custom_topics(rows: List[RosMessage], prefix: str,
                  frame_prefix: str) -> Dict[Type[LayoutMessage], ValuePublisher]:
    """Return the topics of the custom messages from the board, by the messages' classes."""
    return {row.kind: ValuePublisher(prefix + row.custom.name, row.message_class, row.fields,
                                     row.custom.frame_id and frame_prefix + row.custom.frame_id)
            for row in rows if not row.custom.is_command}


def take_commands(rows: List[RosMessage], prefix: str, link: Any, age_limit: float) -> None:
    """Subscribe to the custom commands; one that cannot be sent is refused with a warning."""
    for row in rows:
        if row.custom.is_command:
            _take_command(row, prefix, link, age_limit)


def _take_command(row: RosMessage, prefix: str, link: Any, age_limit: float) -> None:
    def read(message: Any) -> Any:
        return row.kind(*row.fields.read(message))

    CommandTopic(prefix + row.custom.name, row.message_class,
                 lambda message: link.command(read(message)),
                 lambda message: str(read(message))[:_LABEL], link.log, age_limit)
