"""The bus link in ROS: its parameters, its topics and its services."""
from typing import Any, Callable, Dict, List, NamedTuple, Tuple

import rospy
from sensor_msgs.msg import RelativeHumidity, Temperature
from std_srvs.srv import Trigger, TriggerResponse

from serial_communication.msg import Environment
from serial_communication.srv import (BusRequest, BusRequestResponse, GetEnvironment,
                                      GetEnvironmentResponse, Gimbal, GimbalResponse, Lift,
                                      LiftResponse)

from ...link.outcome import NOT_SENT, Outcome
from ...ros.answers import fill_response
from ...ros.custom_topics import ValuePublisher, check_frame_id, names_of, refuse_taken
from ...ros.fields import RosFields, find_type
from ...ros.interface import LinkOptions, Interface
from ...ros.parameter import BAUD, PORT, Parameter, seconds
from ...ros.publishing import publisher, wanted
from ...transport.port import Port
from . import DESCRIPTION, wire
from .functions import CustomFunction, read_functions
from .link import BusLink, BusSettings

_DEFAULTS = BusSettings()


class BusInterface(Interface):
    """Services in, readings out."""

    NAME = DESCRIPTION.name
    PARAMETERS = {
        'port': PORT,
        'baud': BAUD,
        'reply_timeout': seconds(_DEFAULTS.reply_timeout, 0.01, 60.0),
        'motion_timeout': seconds(_DEFAULTS.motion_timeout, 0.01, 600.0),
        'retries': Parameter(_DEFAULTS.retries, 0, 100),
        'environment_period': seconds(_DEFAULTS.environment_period, 0.0, 86400.0),
        'environment_datelen': Parameter(_DEFAULTS.environment_datelen, choices=(0, 2)),
        'reply_has_cmd2': Parameter(_DEFAULTS.reply_has_cmd2),
        'functions': Parameter({}, parse=lambda given: _rows(given)),
    }

    def __init__(self, parameters: Dict[str, Any], link_options: LinkOptions) -> None:
        p = parameters
        self.link = BusLink(
            Port(p['port'], p['baud']),
            BusSettings(**{name: p[name] for name in BusSettings._fields}),
            on_environment=self._publish_environment, **link_options._asdict())
        self._own = p['functions']
        _poll(self._own, self.link, p['frame_prefix'])
        self._environment = publisher('~environment', Environment)
        self._temperature = publisher('~environment/temperature', Temperature)
        self._humidity = publisher('~environment/humidity', RelativeHumidity)
        self._frame_id = p['base_frame_id']

    @staticmethod
    def custom_names(parameters: Dict[str, Any]) -> List[Tuple[str, str]]:
        return names_of(parameters['functions'], '~')

    def advertise(self) -> None:
        """Offer the services."""
        for name, service, handler in (
                ('~lift', Lift, self._lift), ('~gimbal', Gimbal, self._gimbal),
                ('~get_environment', GetEnvironment, self._get_environment),
                ('~bus/request', BusRequest, self._request),
                ('~bus/echo', Trigger, self._echo), ('~bus/sync', Trigger, self._sync)):
            rospy.Service(name, service, handler)
        _offer(self._own, self.link)

    def _lift(self, request) -> LiftResponse:
        return fill_response(LiftResponse(), self.link.lift(request.direction, request.distance))

    def _gimbal(self, request) -> GimbalResponse:
        return fill_response(GimbalResponse(), self.link.gimbal(request.direction, request.angle))

    def _get_environment(self, _request) -> GetEnvironmentResponse:
        outcome, reading = self.link.environment()
        response = fill_response(GetEnvironmentResponse(), outcome)
        if reading:
            response.environment = self._message(reading, rospy.Time.now())
            response.message = f'done: {reading}'
        return response

    def _request(self, request) -> BusRequestResponse:
        outcome = self.link.request(wire.Request(request.cmd1, request.cmd2,
                                                 bytes(request.data)))
        response = fill_response(BusRequestResponse(), outcome)
        response.data = outcome.data
        return response

    def _echo(self, _request) -> TriggerResponse:
        outcome = self.link.echo()
        response = fill_response(TriggerResponse(), outcome)
        if outcome.success:
            response.message = f'{outcome.round_trip * 1e3:.2f} ms'
        return response

    def _sync(self, _request) -> TriggerResponse:
        outcome = self.link.sync()
        response = fill_response(TriggerResponse(), outcome)
        if outcome.success:
            response.message = 'synchronised'
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


class RowFunction(NamedTuple):
    """A custom function, and what it is in ROS."""

    own: CustomFunction      # its reply takes for implausible what a field cannot hold
    ros_class: Any        # of the service, or of the message that is published
    request: Any          # RosFields; None where it is published
    reply: RosFields


def _rows(given: Any) -> List[RowFunction]:
    """What ``bus/functions`` is; RowError for the first mistake in it."""
    return [_row(own) for own in read_functions(given)]


def _row(own: CustomFunction) -> RowFunction:
    refuse_taken(own, '~')
    request = None
    if own.srv_type:
        found = find_type(f'{own.key}/srv_type', own.srv_type, 'srv')
        request = RosFields(found._request_class, own.request, f'{own.key}/request/fields')
        reply = RosFields(found._response_class, own.reply, f'{own.key}/reply/fields')
    else:
        found = find_type(f'{own.key}/ros_type', own.ros_type)
        check_frame_id(own, found)
        reply = RosFields(found, own.reply, f'{own.key}/reply/fields')
    return RowFunction(own._replace(reply=reply.narrowed(own.reply)), found, request, reply)


def _poll(rows: List[RowFunction], link: BusLink, frame_prefix: str) -> None:
    """Ask what is to be published time and again; to be called before the link starts."""
    for row in rows:
        own = row.own
        if own.period:
            topic = ValuePublisher('~' + own.name, row.ros_class, row.reply,
                                   own.frame_id and frame_prefix + own.frame_id)
            link.poll(own.period, own.ask((0,) * len(own.request.values)), own.reply,
                      _publishing(own, topic), own.timeout)


def _publishing(own: CustomFunction, topic: ValuePublisher) -> Callable[[Outcome], None]:
    return lambda outcome: topic.publish(_values(own, outcome), outcome.stamp)


def _values(own: CustomFunction, outcome: Outcome) -> Tuple:
    """Those of an OK. Where no data is expected, the board may have sent some all the same."""
    return () if own.reply.is_empty else own.reply.unpack(outcome.data)


def _offer(rows: List[RowFunction], link: BusLink) -> None:
    """Offer the services of custom functions."""
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
        response = fill_response(row.reply.new(), outcome)
        if outcome.success:
            row.reply.fill(response, _values(own, outcome))
        return response

    return handle


INTERFACE = BusInterface
