"""The bus link in ROS: its parameters, its topics and its services."""
from typing import Any, Dict, List, Tuple

import rospy
from sensor_msgs.msg import RelativeHumidity, Temperature
from std_srvs.srv import Trigger, TriggerResponse

from serial_communication.msg import Environment
from serial_communication.srv import (BusRequest, BusRequestResponse, GetEnvironment,
                                      GetEnvironmentResponse, Gimbal, GimbalResponse, Lift,
                                      LiftResponse)

from ..links.bus import BusLink, BusSettings
from ..protocols import robot_ctrl_bus as bus
from ..transport.port import Port
from .answers import tell
from .interface import Common, Interface
from .parameter import BAUD, PORT, Parameter, seconds
from .publishing import publisher, wanted
from .rows import bus_rows, names_of, offer_functions, poll_functions


class BusInterface(Interface):
    """Services in, readings out."""

    NAME = 'bus'
    PARAMETERS = {
        'port': PORT,
        'baud': BAUD,
        'reply_timeout': seconds(0.5, 0.01, 60.0),
        'motion_timeout': seconds(5.0, 0.01, 600.0),
        'retries': Parameter(2, 0, 100),
        'environment_period': seconds(1.0, 0.0, 86400.0),
        'environment_datelen': Parameter(2, choices=(0, 2)),
        'reply_has_cmd2': Parameter(False),
        'functions': Parameter({}, parse=bus_rows),
    }

    def __init__(self, parameters: Dict[str, Any], common: Common) -> None:
        p = parameters
        self.link = BusLink(
            Port(p['port'], p['baud']),
            BusSettings(p['reply_timeout'], p['motion_timeout'], p['retries'],
                        p['environment_period'], p['environment_datelen'],
                        p['reply_has_cmd2']),
            on_environment=self._publish_environment, **common._asdict())
        self._own = p['functions']
        poll_functions(self._own, self.link, p['frame_prefix'])
        self._environment = publisher('~environment', Environment)
        self._temperature = publisher('~environment/temperature', Temperature)
        self._humidity = publisher('~environment/humidity', RelativeHumidity)
        self._frame_id = p['base_frame_id']

    @staticmethod
    def own_names(parameters: Dict[str, Any]) -> List[Tuple[str, str]]:
        return names_of(parameters['functions'], '~')

    def advertise(self) -> None:
        """Offer the services."""
        for name, service, handler in (
                ('~lift', Lift, self._lift), ('~gimbal', Gimbal, self._gimbal),
                ('~get_environment', GetEnvironment, self._get_environment),
                ('~bus/request', BusRequest, self._request),
                ('~bus/echo', Trigger, self._echo), ('~bus/sync', Trigger, self._sync)):
            rospy.Service(name, service, handler)
        offer_functions(self._own, self.link)

    def _lift(self, request) -> LiftResponse:
        return tell(LiftResponse(), self.link.lift(request.direction, request.distance))

    def _gimbal(self, request) -> GimbalResponse:
        return tell(GimbalResponse(), self.link.gimbal(request.direction, request.angle))

    def _get_environment(self, _request) -> GetEnvironmentResponse:
        outcome, reading = self.link.environment()
        response = tell(GetEnvironmentResponse(), outcome)
        if reading:
            response.environment = self._message(reading, rospy.Time.now())
            response.message = f'done: {reading}'
        return response

    def _request(self, request) -> BusRequestResponse:
        outcome = self.link.request(bus.Request(request.cmd1, request.cmd2,
                                                bytes(request.data)))
        response = tell(BusRequestResponse(), outcome)
        response.data = outcome.data
        return response

    def _echo(self, _request) -> TriggerResponse:
        outcome = self.link.echo()
        response = tell(TriggerResponse(), outcome)
        if outcome.success:
            response.message = f'{outcome.round_trip * 1e3:.2f} ms'
        return response

    def _sync(self, _request) -> TriggerResponse:
        outcome = self.link.sync()
        response = tell(TriggerResponse(), outcome)
        if outcome.success:
            response.message = 'synchronised'
        return response

    def _publish_environment(self, reading: bus.Environment, stamp: rospy.Time) -> None:
        message = self._message(reading, stamp)
        self._environment.publish(message)
        if wanted(self._temperature):
            self._temperature.publish(Temperature(message.header, reading.temperature, 0.0))
        if wanted(self._humidity):
            self._humidity.publish(RelativeHumidity(message.header, reading.humidity / 100, 0.0))

    def _message(self, reading: bus.Environment, stamp: rospy.Time) -> Environment:
        message = Environment(None, *reading)
        message.header.stamp = stamp
        message.header.frame_id = self._frame_id
        return message


INTERFACE = BusInterface
