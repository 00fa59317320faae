"""Topics and services of one's own messages: rows of parameters joined to types of ROS.

Each of these is made at the start, with its publishers and subscribers, so that every mistake in a
row is found before a port is opened.
"""
from typing import Any, Callable, Dict, Iterable, List

import rospy

from ..links.bus import BusLink
from ..links.link import Refused
from ..links.master import NOT_SENT, Outcome
from ..protocols.layout import Row, message_class
from ..protocols.own_messages import OwnFunction, OwnMessage, RowError
from .publishing import publisher, wanted
from .ros_fields import RosFields, find_type


class _Topic:
    """One message or reply of the board's on one topic."""

    def __init__(self, name: str, own: Any, layout: Any, fields_key: str,
                 frame_prefix: str) -> None:
        found = find_type(f'{own.key}/ros_type', own.ros_type)
        self.fields = RosFields(found, layout, fields_key)
        self._message = self.fields.new()
        self._has_header = found._has_header
        if own.frame_id:
            if not self._has_header:
                raise RowError(f'{own.key}/frame_id', own.frame_id, 'needs a type with a header, '
                               f'which {own.ros_type} has not')
            self._message.header.frame_id = frame_prefix + own.frame_id
        self.topic = publisher(name, found)

    def publish(self, values: Any, stamp: rospy.Time) -> None:
        """If anybody subscribes."""
        if wanted(self.topic):
            if self._has_header:
                self._message.header.stamp = stamp
            self.topic.publish(self.fields.fill(self._message, values))


class OwnTopics:
    """The messages of one link.

    Args:
        messages: of the parameters.
        prefix: of the topics' names.
        taken: names that the link has itself.
        frame_prefix: put before every frame id.
    """

    def __init__(self, messages: Iterable[OwnMessage], prefix: str, taken: Iterable[str],
                 frame_prefix: str = '') -> None:
        self.kinds: List[Any] = []                    # for the decoder
        self._topics: Dict[Any, _Topic] = {}
        self._commands = []
        for own in messages:
            _refuse_taken(own, taken)
            if own.is_command:
                found = find_type(f'{own.key}/ros_type', own.ros_type)
                fields = RosFields(found, own.kind.LAYOUT, f'{own.key}/fields')
                self._commands.append((prefix + own.name, found, own.kind, fields))
                continue
            topic = _Topic(prefix + own.name, own, own.kind.LAYOUT, f'{own.key}/fields',
                           frame_prefix)
            layout = topic.fields.narrowed(own.kind.LAYOUT)
            kind = message_class(own.name, own.kind.TYPE, layout.layout, layout.values)
            self.kinds.append(kind)
            self._topics[kind] = topic

    def publish(self, message: Row, stamp: rospy.Time) -> bool:
        """Publish a message if it is one of these; return whether it is."""
        topic = self._topics.get(type(message))
        if topic is None:
            return False
        topic.publish(message, stamp)
        return True

    def subscribe(self, link: Any) -> None:
        """Take commands and send them on; what cannot be sent is refused with a warning."""
        for name, found, kind, fields in self._commands:
            def take(message: Any, name=name, kind=kind, fields=fields) -> None:
                try:
                    link.send_command(kind(*fields.read(message)))
                except ValueError as error:
                    link.log.warn(f'{name} refused', f'{kind.LABEL} refused: {error}')
                except Refused as refused:
                    link.log.warn(f'{name} refused: {refused.cause}', str(refused))
            rospy.Subscriber(name, found, take, queue_size=10, tcp_nodelay=True)


class OwnServices:
    """The functions of the bus: services, and topics of what is asked time and again."""

    def __init__(self, functions: Iterable[OwnFunction], taken: Iterable[str],
                 frame_prefix: str = '') -> None:
        self._services = []
        self._polls = []
        for own in functions:
            _refuse_taken(own, taken)
            if own.srv_type:
                found = find_type(f'{own.key}/srv_type', own.srv_type, 'srv')
                request = RosFields(found._request_class, own.request, f'{own.key}/request/fields')
                reply = RosFields(found._response_class, own.reply, f'{own.key}/reply/fields')
                own = own._replace(reply=reply.narrowed(own.reply))
                self._services.append((own, found, request, reply))
            else:
                topic = _Topic('~' + own.name, own, own.reply, f'{own.key}/reply/fields',
                               frame_prefix)
                self._polls.append((own._replace(reply=topic.fields.narrowed(own.reply)), topic))

    def attach(self, link: BusLink) -> None:
        """To be called before the link starts: what is asked time and again."""
        for own, topic in self._polls:
            link.poll(own.period, own.ask(()), own.reply, _publisher(own, topic), own.timeout)

    def advertise(self, link: BusLink) -> None:
        """Offer the services."""
        for own, found, request, reply in self._services:
            rospy.Service('~' + own.name, found, _handler(link, own, found, request, reply))


def _publisher(own: OwnFunction, topic: _Topic) -> Callable[[Outcome], None]:
    return lambda outcome: topic.publish(own.reply.unpack(outcome.data), outcome.stamp)


def _handler(link: BusLink, own: OwnFunction, found: Any, request_fields: RosFields,
             reply_fields: RosFields) -> Callable[[Any], Any]:
    types = dict(zip(found._response_class.__slots__, found._response_class._slot_types))
    told = [name for name, fitting in (
        ('success', ('bool',)), ('status', ('uint8', 'int32', 'uint32', 'int64', 'uint64')),
        ('error_code', ('uint16', 'int32', 'uint32', 'int64', 'uint64')), ('message', ('string',)))
        if types.get(name) in fitting]

    def handle(request: Any) -> Any:
        try:
            asked = own.ask(request_fields.read(request))
        except ValueError as error:
            outcome = Outcome(NOT_SENT, f'{error}; nothing was sent')
        else:
            outcome = link.request(asked, own.repeatable, own.timeout, own.reply)
        response = reply_fields.new()
        if not outcome.success and 'success' not in told:
            raise rospy.ServiceException(outcome.message)
        for name in told:
            setattr(response, name, getattr(outcome, name))
        if outcome.success:
            reply_fields.fill(response, own.reply.unpack(outcome.data))
        return response
    return handle


def _refuse_taken(own: Any, taken: Iterable[str]) -> None:
    if own.name in taken:
        raise RowError(own.key, own.name, 'is a name that the bridge has itself')
