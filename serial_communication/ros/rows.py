"""Topics and services of messages that are rows, the package's own simple ones and the users'.

What rows of parameters have of ROS is resolved as the parameters are checked, so that every
mistake in them ends the node before it has registered anything or opened a port.
"""
from typing import Any, Callable, Container, List, NamedTuple, Tuple

import rospy

from ..links.bus import BusLink
from ..links.outcome import NOT_SENT, Outcome
from ..protocols.layout import message_class
from ..protocols.own_messages import (OwnFunction, OwnMessage, RowError, arduino_messages,
                                      bus_functions, mcu_messages)
from .answers import tell
from .commands import CommandTopic
from .publishing import publisher, wanted
from .ros_fields import RosFields, find_type

# What stands beside one's own names: the node's private names and those in mcu/.
PRIVATE_NAMES = ('imu', 'voltage', 'ticks', 'steering_angle', 'environment', 'speed', 'steering',
                 'led', 'lift', 'gimbal', 'get_environment', 'bus', 'calibrate_imu',
                 'get_loggers', 'set_logger_level')
_LABEL = 100     # characters of a command's values in a warning
MCU_NAMES = ('status', 'adc_status', 'imu', 'range_1', 'range_2')


class RowMessage(NamedTuple):
    """A message of one's own, and what it is in ROS."""

    own: OwnMessage
    kind: Any             # its class, which takes for implausible what a field cannot hold
    message_class: Any    # of ROS
    fields: RosFields


class RowFunction(NamedTuple):
    """A function of one's own, and what it is in ROS."""

    own: OwnFunction      # its reply takes for implausible what a field cannot hold
    ros_class: Any        # of the service, or of the message that is published
    request: Any          # RosFields; None where it is published
    reply: RosFields


def arduino_rows(given: Any) -> List[RowMessage]:
    """What ``arduino/messages`` is; RowError for the first mistake in it."""
    return [_row_message(own, PRIVATE_NAMES) for own in arduino_messages(given)]


def mcu_rows(given: Any) -> List[RowMessage]:
    """What ``mcu/messages`` is; RowError for the first mistake in it."""
    return [_row_message(own, MCU_NAMES) for own in mcu_messages(given)]


def bus_rows(given: Any) -> List[RowFunction]:
    """What ``bus/functions`` is; RowError for the first mistake in it."""
    return [_row_function(own) for own in bus_functions(given)]


def names_of(rows: List[Any], prefix: str) -> List[Tuple[str, str]]:
    """The topics and services that rows make: (name, the parameter that makes it)."""
    return [(prefix + row.own.name, row.own.key) for row in rows]


def _row_message(own: OwnMessage, taken: Container[str]) -> RowMessage:
    _refuse_taken(own, taken)
    found = find_type(f'{own.key}/ros_type', own.ros_type)
    _check_frame_id(own, found)
    fields = RosFields(found, own.kind.LAYOUT, f'{own.key}/fields')
    layout = fields.narrowed(own.kind.LAYOUT)
    kind = own.kind if own.is_command else message_class(own.name, own.kind.TYPE, layout.layout,
                                                         layout.values)
    return RowMessage(own, kind, found, fields)


def _row_function(own: OwnFunction) -> RowFunction:
    _refuse_taken(own, PRIVATE_NAMES)
    request = None
    if own.srv_type:
        found = find_type(f'{own.key}/srv_type', own.srv_type, 'srv')
        request = RosFields(found._request_class, own.request, f'{own.key}/request/fields')
        reply = RosFields(found._response_class, own.reply, f'{own.key}/reply/fields')
    else:
        found = find_type(f'{own.key}/ros_type', own.ros_type)
        _check_frame_id(own, found)
        reply = RosFields(found, own.reply, f'{own.key}/reply/fields')
    return RowFunction(own._replace(reply=reply.narrowed(own.reply)), found, request, reply)


def _refuse_taken(own: Any, taken: Container[str]) -> None:
    if own.name in taken:
        raise RowError(own.key, own.name, 'may have a name that the bridge has not itself')


def _check_frame_id(own: Any, found: Any) -> None:
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


def poll_functions(rows: List[RowFunction], link: BusLink, frame_prefix: str) -> None:
    """Ask what is to be published time and again; to be called before the link starts."""
    for row in rows:
        own = row.own
        if own.period:
            topic = RowTopic('~' + own.name, row.ros_class, row.reply,
                             own.frame_id and frame_prefix + own.frame_id)
            link.poll(own.period, own.ask((0,) * len(own.request.values)), own.reply,
                      _publishing(own, topic), own.timeout)


def _publishing(own: OwnFunction, topic: RowTopic) -> Callable[[Outcome], None]:
    return lambda outcome: topic.publish(_values(own, outcome), outcome.stamp)


def _values(own: OwnFunction, outcome: Outcome) -> Tuple:
    """Those of an OK. Where no data is expected, the board may have sent some all the same."""
    return () if own.reply.is_empty else own.reply.unpack(outcome.data)


def offer_functions(rows: List[RowFunction], link: BusLink) -> None:
    """Offer the services of one's own functions."""
    for row in rows:
        if not row.own.period:
            rospy.Service('~' + row.own.name, row.ros_class, _service(row, link))


def _service(row: RowFunction, link: BusLink) -> Callable[[Any], Any]:
    own = row.own

    def handle(request: Any) -> Any:
        try:
            asked = own.ask(row.request.read(request))
        except ValueError as error:
            outcome = Outcome(NOT_SENT, f'{error}; nothing was sent')
        else:
            outcome = link.request(asked, own.repeatable, own.timeout, own.reply)
        response = tell(row.reply.new(), outcome)
        if outcome.success:
            row.reply.fill(response, _values(own, outcome))
        return response

    return handle
