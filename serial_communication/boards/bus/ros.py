"""The bus link in ROS: its parameters, its topics and its services."""
import os
from typing import Any, Callable, Dict, List, NamedTuple, Optional, Tuple

import rospy
from sensor_msgs.msg import RelativeHumidity, Temperature
from std_srvs.srv import TriggerResponse

from serial_communication.msg import Environment
from serial_communication.srv import BusRequest, BusRequestResponse, GetEnvironmentResponse

from ...framing.custom_messages import RowError
from ...link.link import Refused
from ...link.outcome import NOT_SENT, Outcome
from ...ros.announced import AnnouncedRows
from ...ros.answers import fill_response
from ...ros.custom_topics import ValuePublisher, check_frame_ids, names_of, refuse_taken
from ...ros.fields import RosFields, find_type
from ...ros.interface import LinkOptions, Interface
from ...ros.parameter import PORT, Parameter, baud, seconds
from ...ros.publishing import publisher, wanted
from ...transport.port import Port
from . import DESCRIPTION, wire
from .functions import read_functions
from .link import BusLink, BusSettings
from .polls import Poller

_DEFAULTS = BusSettings()


class BusInterface(Interface):
    """Offers services and publishes readings."""

    NAME = DESCRIPTION.name
    PARAMETERS = {
        'port': PORT,
        'baud': baud(DESCRIPTION),
        'reply_timeout': seconds(_DEFAULTS.reply_timeout, 0.01, 60.0),
        'motion_timeout': seconds(_DEFAULTS.motion_timeout, 0.01, 600.0),
        'retries': Parameter(_DEFAULTS.retries, 0, 100),
        'environment_period': seconds(_DEFAULTS.environment_period, 0.0, 86400.0),
        'environment_datelen': Parameter(_DEFAULTS.environment_datelen, choices=(0, 2)),
        'reply_has_cmd2': Parameter(_DEFAULTS.reply_has_cmd2),
        'echo': Parameter(_DEFAULTS.echo),
        'functions': Parameter({}, parse=lambda given: [
            _ros_function(function) for function in read_functions(given)]),
        'announcements': Parameter(_DEFAULTS.announcements),
    }
    link: BusLink

    def __init__(self, parameters: Dict[str, Any], link_options: LinkOptions) -> None:
        p = parameters
        self.link = BusLink(
            Port(p['port'], p['baud']),
            BusSettings(**{name: p[name] for name in BusSettings._fields}),
            on_environment=self._publish_environment, **link_options._asdict())
        self._functions = p['functions']
        for row in self._functions:
            if row.custom.period:
                _poll(row, self.link, p)
        if p['announcements']:
            self.announced = AnnouncedRows(
                DESCRIPTION, self.link, [row.custom for row in self._functions], _ros_function,
                lambda row: _add_announced(row, self.link, p))
        self._environment = publisher('~environment', Environment)
        self._temperature = publisher('~environment/temperature', Temperature)
        self._humidity = publisher('~environment/humidity', RelativeHumidity)
        self._frame_id = p['base_frame_id']

    @staticmethod
    def custom_names(parameters: Dict[str, Any]) -> List[Tuple[str, str]]:
        return names_of(parameters['functions'], '~')

    def advertise(self) -> None:
        """Advertise the services."""
        own = {wire.ENVIRONMENT_FUNCTION.service: self._get_environment,
               wire.ECHO_FUNCTION.service: self._echo, wire.SYNC_FUNCTION.service: self._sync}
        for function in wire.BUILT_IN.values():
            if function.service in own:
                rospy.Service(function.service, find_type(function.name, function.srv_type, 'srv'),
                              own[function.service])
            elif function.service:
                _advertise(_with_types(function), self.link)
        rospy.Service('~bus/request', BusRequest, self._request)
        for row in self._functions:
            if row.request:
                _advertise(row, self.link)

    def _get_environment(self, _request: Any) -> GetEnvironmentResponse:
        outcome, reading = self.link.environment()
        response = fill_response(GetEnvironmentResponse(), outcome)
        if reading:
            response.environment = self._message(reading, outcome.stamp)
            response.message = f'done: {reading}'
        return response

    def _request(self, request: Any) -> BusRequestResponse:
        outcome = self.link.request(wire.Request(request.cmd1, request.cmd2,
                                                 bytes(request.data)))
        response = fill_response(BusRequestResponse(), outcome)
        response.data = outcome.data
        return response

    def _echo(self, _request: Any) -> TriggerResponse:
        outcome = self.link.call(wire.ECHO_FUNCTION, (os.urandom(4),))
        return self._trigger(outcome, f'{outcome.round_trip * 1e3:.2f} ms')

    def _sync(self, _request: Any) -> TriggerResponse:
        return self._trigger(self.link.call(wire.SYNC_FUNCTION, ()), 'synchronised')

    @staticmethod
    def _trigger(outcome: Outcome, done: str) -> TriggerResponse:
        response = fill_response(TriggerResponse(), outcome)
        if outcome.success:
            response.message = done
        return response

    def _publish_environment(self, reading: wire.Environment, stamp: rospy.Time) -> None:
        message = self._message(reading, stamp)
        self._environment.publish(message)
        if wanted(self._temperature):
            self._temperature.publish(Temperature(message.header, reading.temperature, 0.0))
        if wanted(self._humidity):
            self._humidity.publish(RelativeHumidity(message.header, reading.humidity / 100, 0.0))

    def _message(self, reading: wire.Environment, stamp: rospy.Time) -> Environment:
        message = Environment(None, *reading)
        message.header.stamp = stamp
        message.header.frame_id = self._frame_id
        return message


# -- custom functions --------------------------------------------------------------------------


class RosFunction(NamedTuple):
    """A custom function with its ROS types."""

    custom: wire.Function           # its reply also has the limits of the ROS fields
    ros_class: Any                   # class of the service, or of the published message
    request: Optional[RosFields]     # None for a polled topic
    reply: RosFields


def _ros_function(function: wire.Function) -> RosFunction:
    refuse_taken(function, '~')
    return _with_types(function)


def _with_types(function: wire.Function) -> RosFunction:
    key, request = function.key, None
    if function.srv_type:
        found = find_type(f'{key}/srv_type', function.srv_type, 'srv')
        request = RosFields(found._request_class, function.request, f'{key}/request/fields')
        reply = RosFields(found._response_class, function.reply, f'{key}/reply/fields')
        if function.interrupts:
            try:
                _stop_request(RosFunction(function, found, request, reply))
            except ValueError as error:
                raise RowError(f'{key}/interrupts', True, 'needs a request that allows 0 in '
                               f'every field: {error}') from None
        for value in map(function.reply.values.__getitem__, reply.without_nan):
            raise RowError(f'{key}/reply/invalid', value.invalid, f'needs a float field, but '
                           f'{value.name} is none, and a response cannot be left out')
    else:
        found = find_type(f'{key}/ros_type', function.ros_type)
        check_frame_ids(function, found)
        reply = RosFields(found, function.reply, f'{key}/reply/fields', function.constants,
                          f'{key}/constants')
    narrowed = function._replace(reply=reply.narrowed(function.reply))
    return RosFunction(narrowed, found, request, reply)


def _stop_request(row: RosFunction) -> wire.Request:
    """The request with every field 0, which ~stop sends; ValueError if that is out of range."""
    assert row.request
    return row.custom.make_request(row.request.read(row.ros_class._request_class()))


def _poll(row: RosFunction, link: BusLink, p: Dict[str, Any]) -> Tuple[Poller, ValuePublisher]:
    """Call a function with a period, and publish its replies."""
    function = row.custom
    topic = ValuePublisher('~' + function.name, row.ros_class, row.reply, function, p)
    return link.session.polls.add(function, function.period, lambda outcome: topic.publish(
        _values(function, outcome), outcome.stamp)), topic


def _values(function: wire.Function, outcome: Outcome) -> Tuple:
    """The values of an OK. Data that is not expected is left out."""
    return () if function.reply.is_empty else function.reply.unpack(outcome.data)


def _add_announced(row: RosFunction, link: BusLink, p: Dict[str, Any]) -> Callable[[], None]:
    """Make the service or the poll of an announced function; return what takes it down."""
    row = row._replace(custom=row.custom._replace(announced=True))
    if row.request:
        service = _advertise(row, link)

        def withdraw() -> None:
            link.session.stops = [stop for stop in link.session.stops if stop[1] is not row.custom]
            service.shutdown('the board announces it no longer')

        return withdraw
    poller, topic = _poll(row, link, p)

    def take_down() -> None:
        link.session.polls.remove(poller)
        topic.close()

    return take_down


def _advertise(row: RosFunction, link: BusLink) -> rospy.Service:
    """Offer a function whose values have the names of its service's fields."""
    function, request_fields = row.custom, row.request
    if function.interrupts:
        link.session.stops.append((_stop_request(row), function))

    def handle(ros_request: Any) -> Any:
        try:
            if function.announced:
                link.session.announcement.refuse_unless_current(function.name)
            values = request_fields.read(ros_request) if request_fields else ()
        except (ValueError, Refused) as error:
            outcome = Outcome(NOT_SENT, f'{error}; nothing was sent')
        else:
            outcome = link.call(function, values)
        response = fill_response(row.reply.new(), outcome)
        if outcome.success:
            row.reply.fill(response, _values(function, outcome))
        return response

    return rospy.Service(function.service, row.ros_class, handle)


INTERFACE = BusInterface
