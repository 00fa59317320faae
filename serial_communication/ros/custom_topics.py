"""Topics of custom messages, and of those built-in messages that need no code of their own.

The ROS types and fields in the rows are resolved while the parameters are checked. So a mistake in
a row ends the node before it has registered anything or opened a port.
"""
import threading
from typing import Any, Callable, List, NamedTuple, Sequence, Set, Tuple, Type

import rospy

from ..boards import descriptions
from ..boards.description import Description
from ..framing.custom_messages import CustomMessage, RowError
from ..framing.layout import LayoutMessage
from ..framing.settings import Setting
from .announced import AnnouncedRows
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
    custom = board.custom
    return [resolve(each, custom.prefix) for each in custom.read(given)] if custom else []


def names_of(rows: Sequence[Tuple], prefix: str) -> List[Tuple[str, str]]:
    """Return the topics and services that rows, such as `RosMessage`, add: (name, parameter)."""
    return [(prefix + custom.name, custom.key) for custom, *_ in rows]


def resolve(custom: CustomMessage, prefix: str) -> RosMessage:
    """Return a custom message with its ROS type and fields; raise RowError for a mistake."""
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
    for board in descriptions():
        names.update(name[len(prefix):].split('/')[0] for name in board.names
                     if name.startswith(prefix))
    return names


def check_frame_id(custom: Any, found: Any) -> None:
    """Raise RowError if a row has a frame id, but its ROS type has no header."""
    if custom.frame_id and not found._has_header:
        raise RowError(f'{custom.key}/frame_id', custom.frame_id,
                       f'needs a type with a header, {found._type} has none')


class ValuePublisher:
    """Publishes tuples of values as messages of one ROS type, while the topic has subscribers.

    A message is left out if one of its values is "no value" and its field cannot be NaN.
    """

    def __init__(self, name: str, ros_class: Any, fields: RosFields, frame_id: str = '') -> None:
        self._lock = threading.Lock()     # held while a message is published or the topic closed
        self._topic = publisher(name, ros_class)
        self._fields = fields
        self._message = fields.new()
        self._has_header = ros_class._has_header
        if frame_id:
            self._message.header.frame_id = frame_id

    def publish(self, values: Tuple, stamp: rospy.Time) -> None:
        """Publish a message with these values; do nothing once it is closed."""
        with self._lock:
            topic = self._topic
            if topic is not None and wanted(topic) and not self._fields.lacks(values):
                if self._has_header:
                    self._message.header.stamp = stamp
                topic.publish(self._fields.fill(self._message, values))

    def close(self) -> None:
        """Unregister the topic; may be called from any thread, at any time."""
        with self._lock:
            topic, self._topic = self._topic, None
        topic.unregister()


class MessageTopics:
    """The topics of a board whose messages need no code of their own.

    They are those of the description that have a message class, of custom messages, and of
    announced ones.
    """

    def __init__(self, board: Description, rows: List[RosMessage], frame_prefix: str) -> None:
        assert board.custom, f'{board.name} has no custom rows'
        self._board = board
        self._prefix = board.custom.prefix
        self._rows = rows
        self._frame_prefix = frame_prefix
        # By the classes of their messages.
        self._topics = {row.kind: self._topic(row) for row in rows if not row.custom.is_command}
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
        settings = link.board_settings
        return AnnouncedRows(
            self._board, link, [*(row.custom for row in self._rows), *settings.rows],
            lambda custom: custom if isinstance(custom, Setting) else resolve(custom, self._prefix),
            lambda row: settings.add(row, announced=True) if isinstance(row, Setting) else
            self._add(row, link, age_limit))

    def _topic(self, row: RosMessage) -> ValuePublisher:
        return ValuePublisher(self._prefix + row.custom.name, row.message_class, row.fields,
                              row.custom.frame_id and self._frame_prefix + row.custom.frame_id)

    def _take_command(self, row: RosMessage, link: Any, age_limit: float) -> CommandTopic:
        def read(message: Any) -> Any:
            return row.kind(*row.fields.read(message))

        return CommandTopic(self._prefix + row.custom.name, row.message_class,
                            lambda message: link.command(read(message)),
                            lambda message: str(read(message))[:_LABEL], link.log, age_limit)

    def _add(self, row: RosMessage, link: Any, age_limit: float) -> Callable[[], None]:
        """Make the topic or the subscription of an announced row; return what takes it down."""
        row.kind.ANNOUNCED = True
        if row.custom.is_command:
            return self._take_command(row, link, age_limit).close

        def take_down() -> None:
            link.decoder.remove_message(row.kind)
            self._topics.pop(row.kind).close()

        self._topics[row.kind] = self._topic(row)
        link.decoder.add_message(row.kind)
        return take_down
