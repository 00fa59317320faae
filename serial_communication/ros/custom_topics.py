"""Topics of custom messages, and of those built-in messages that need no code of their own.

The ROS types and fields in the rows are resolved while the parameters are checked. So a mistake in
a row ends the node before it has registered anything or opened a port.
"""
import threading
from typing import (Any, Callable, Dict, List, NamedTuple, Optional, Sequence, Set, Tuple,
                    Type)

import rospy

from ..boards import descriptions
from ..boards.description import Description
from ..framing.custom_messages import CustomMessage, RowError
from ..framing.layout import LayoutMessage
from ..framing.settings import Setting
from .announced import AnnouncedRows
from .commands import CommandTopic
from .fields import RosFields, find_type
from .geometry import FrameBroadcaster
from .publishing import publisher, wanted

_NODE_SERVICES = {'get_loggers', 'set_logger_level', 'stop'}     # of the node itself
ODOMETRY = 'nav_msgs/Odometry'
MOTIONS = 'geometry_msgs/Twist', 'geometry_msgs/TwistStamped'     # ~stop sends their zero
_LABEL = 100     # characters of a command's values in a warning


class RosMessage(NamedTuple):
    """A custom message with its ROS type and fields."""

    custom: CustomMessage
    kind: Type[LayoutMessage]    # its message class, with the limits of the ROS fields, too
    message_class: Any           # of ROS
    fields: RosFields

    @property
    def is_motion(self) -> bool:
        """Whether it is a command that ~stop has to stop."""
        return self.custom.is_command and self.custom.ros_type in MOTIONS

    def read(self, message: Any) -> LayoutMessage:
        """Return what is sent to the board; ValueError for a value out of range."""
        return self.kind(*self.fields.read(message))


def message_rows(board: Description, given: Any) -> List[RosMessage]:
    """Return the custom messages in a board's parameter `messages`.

    Raises:
        RowError: for the first mistake.
    """
    custom = board.custom
    return [resolve(each, custom.prefix) for each in custom.read(given)] if custom else []


def names_of(rows: Sequence[Tuple], prefix: str) -> List[Tuple[str, str]]:
    """Return the topics and services that rows, such as `RosMessage`, add: (name, parameter)."""
    return [(prefix + custom.name, custom.key) for custom, *_ in rows]


def resolve(custom: CustomMessage, prefix: str) -> RosMessage:
    """Return a custom message with its ROS type and fields; raise RowError for a mistake."""
    refuse_taken(custom, prefix)
    found = find_type(f'{custom.key}/ros_type', custom.ros_type)
    check_frame_ids(custom, found)
    fields = RosFields(found, custom.kind.LAYOUT, f'{custom.key}/fields', custom.constants,
                       f'{custom.key}/constants')
    kind = custom.kind if custom.is_command else type(custom.name, (custom.kind,), {
        '__slots__': (), 'LAYOUT': fields.narrowed(custom.kind.LAYOUT)})
    row = RosMessage(custom, kind, found, fields)
    if row.is_motion:
        reason = row.read(found()).implausible()
        if reason:
            raise RowError(f'{custom.key}/minimum', reason, 'has to allow the zero of a motion')
    return row


def refuse_taken(custom: Any, prefix: str) -> None:
    """Raise RowError if a row's name with this prefix is a name that the bridge uses."""
    if custom.name in taken_names(prefix):
        raise RowError(custom.key, custom.name, 'may not be a name that the bridge uses')


def taken_names(prefix: str) -> Set[str]:
    """Return the names, without this prefix, that the built-in boards and every node use."""
    names = set(_NODE_SERVICES) if prefix == '~' else set()
    for board in descriptions():
        names.update(name[len(prefix):].split('/')[0] for name in board.names
                     if name.startswith(prefix))
    return names


def check_frame_ids(custom: Any, found: Any) -> None:
    """Raise RowError if a row has a frame id, but its ROS type has no field for it."""
    if custom.frame_id and not found._has_header:
        raise RowError(f'{custom.key}/frame_id', custom.frame_id,
                       f'needs a type with a header, {found._type} has none')
    if custom.child_frame_id and 'child_frame_id' not in found.__slots__:
        raise RowError(f'{custom.key}/child_frame_id', custom.child_frame_id,
                       f'needs a type with child_frame_id, as {ODOMETRY}; {found._type} has none')
    if custom.child_frame_id and 'child_frame_id' in custom.constants:
        raise RowError(f'{custom.key}/constants', 'child_frame_id', 'is a key of the row, too')


class ValuePublisher:
    """Publishes tuples of values as messages of one ROS type, while the topic has subscribers.

    A message is left out if one of its values is "no value" and its field cannot be NaN. The pose
    of a nav_msgs/Odometry is on /tf, too, if the parameters say so.

    Args:
        fields: of the type.
        custom: the row, with its frame ids; None: there is none.
        p: the parameters publish_tf and frame_prefix.
    """

    def __init__(self, name: str, ros_class: Any, fields: RosFields, custom: Any = None,
                 p: Optional[Dict[str, Any]] = None) -> None:
        self._lock = threading.Lock()     # held while a message is published or the topic closed
        self._topic = publisher(name, ros_class)
        self._fields = fields
        self._message = fields.new()
        self._has_header = ros_class._has_header
        self._broadcaster: Optional[FrameBroadcaster] = None
        if custom and p and custom.frame_id:
            self._message.header.frame_id = p['frame_prefix'] + custom.frame_id
        if custom and p and custom.child_frame_id:
            self._message.child_frame_id = p['frame_prefix'] + custom.child_frame_id
            if p['publish_tf'] and ros_class._type == ODOMETRY:
                self._broadcaster = FrameBroadcaster(self._message.header.frame_id,
                                                     self._message.child_frame_id)

    def publish(self, values: Tuple, stamp: rospy.Time) -> None:
        """Publish a message with these values; do nothing once it is closed."""
        with self._lock:
            topic, broadcaster = self._topic, self._broadcaster
            if topic is None or not (wanted(topic) or broadcaster and broadcaster.is_wanted) \
                    or self._fields.lacks(values):
                return
            message = self._fields.fill(self._message, values)
            if self._has_header:
                message.header.stamp = stamp
            if wanted(topic):
                topic.publish(message)
            if broadcaster:
                at, turn = message.pose.pose.position, message.pose.pose.orientation
                broadcaster.send((at.x, at.y, at.z), (turn.x, turn.y, turn.z, turn.w), stamp)

    def close(self) -> None:
        """Unregister the topic; may be called from any thread, at any time."""
        with self._lock:
            topic, self._topic = self._topic, None
        topic.unregister()
        if self._broadcaster:
            self._broadcaster.close()


class MessageTopics:
    """The topics of a board whose messages need no code of their own.

    They are those of the description that have a message class, of custom messages, and of
    announced ones.

    Args:
        p: the parameters messages, publish_tf and frame_prefix.
    """

    def __init__(self, board: Description, p: Dict[str, Any]) -> None:
        assert board.custom, f'{board.name} has no custom rows'
        self._board = board
        self._prefix = board.custom.prefix
        self._p = p
        self._rows: List[RosMessage] = p['messages']
        # By the classes of their messages.
        self._topics = {row.kind: self._topic(row) for row in self._rows
                        if not row.custom.is_command}
        self.custom_kinds = list(self._topics)
        for topic in board.topics:
            if topic.message:
                ros_class = find_type(topic.name, topic.type)
                self._topics[topic.message] = ValuePublisher(
                    topic.name, ros_class, RosFields(ros_class, topic.message.LAYOUT, topic.name))

    def publish(self, message: Any, stamp: rospy.Time) -> None:
        """Publish a message; do nothing if its topic was just taken down."""
        topic = self._topics.get(type(message))
        if topic:
            topic.publish(message, stamp)

    def take_commands(self, link: Any, age_limit: float) -> None:
        """Subscribe to the custom commands; one that cannot be sent is refused with a warning."""
        for row in self._rows:
            if row.custom.is_command:
                self._take_command(row, link, age_limit)

    def announced(self, link: Any, age_limit: float = 0.0) -> AnnouncedRows:
        """Return the rows that the link's board announces."""
        settings = link.session.board_settings
        return AnnouncedRows(
            self._board, link, [*(row.custom for row in self._rows), *settings.rows],
            lambda custom: custom if isinstance(custom, Setting) else resolve(custom, self._prefix),
            lambda row: settings.add(row, announced=True) if isinstance(row, Setting) else
            self._add(row, link, age_limit))

    def _topic(self, row: RosMessage) -> ValuePublisher:
        return ValuePublisher(self._prefix + row.custom.name, row.message_class, row.fields,
                              row.custom, self._p)

    def _take_command(self, row: RosMessage, link: Any, age_limit: float) -> Callable[[], None]:
        """Subscribe to a custom command; return what ends that."""
        zero = row.read(row.message_class()) if row.is_motion else None
        topic = CommandTopic(self._prefix + row.custom.name, row.message_class,
                             lambda message: link.command(row.read(message)),
                             lambda message: str(row.read(message))[:_LABEL], link.log, age_limit,
                             stops=lambda message: zero is not None and row.read(message) == zero)
        if zero is None:
            return topic.close

        def close() -> None:
            topic.close()
            link.remove_motion(zero)

        link.add_motion(zero)
        return close

    def _add(self, row: RosMessage, link: Any, age_limit: float) -> Callable[[], None]:
        """Make the topic or the subscription of an announced row; return what takes it down."""
        row.kind.ANNOUNCED = True
        if row.custom.is_command:
            return self._take_command(row, link, age_limit)

        def take_down() -> None:
            link.session.decoder.remove_message(row.kind)
            self._topics.pop(row.kind).close()

        self._topics[row.kind] = self._topic(row)
        link.session.decoder.add_message(row.kind)
        return take_down
