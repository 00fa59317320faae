"""The bus link in ROS: its parameters, its topics and its services."""
import os
from typing import Any, Dict

import rospy
from sensor_msgs.msg import RelativeHumidity, Temperature
from std_msgs.msg import Header
from std_srvs.srv import Trigger, TriggerResponse

from serial_communication.msg import Environment
from serial_communication.srv import (BusRequest, BusRequestResponse, GetEnvironment,
                                      GetEnvironmentResponse)

from ...ros.answers import fill_response
from ...ros.binder import Binder
from ...ros.interface import Interface, link_arguments
from ...ros.logs import LOGGER
from ...ros.parameter import Parameter, seconds
from ...ros.publishing import publisher
from ...ros.rows import board_parameters
from . import DESCRIPTION, wire
from .link import BusLink, BusSettings

_DEFAULTS = BusSettings()


class BusInterface(Interface):
    """Offers services and publishes readings."""

    NAME = DESCRIPTION.name
    PARAMETERS = {
        **board_parameters(DESCRIPTION, _DEFAULTS.announcements),
        'reply_timeout': seconds(_DEFAULTS.reply_timeout, 0.01, 60.0),
        'motion_timeout': seconds(_DEFAULTS.motion_timeout, 0.01, 600.0),
        'retries': Parameter(_DEFAULTS.retries, 0, 100),
        'environment_period': seconds(_DEFAULTS.environment_period, 0.0, 86400.0),
        'environment_datelen': Parameter(_DEFAULTS.environment_datelen, choices=(0, 2)),
        'reply_has_cmd2': Parameter(_DEFAULTS.reply_has_cmd2),
        'echo': Parameter(_DEFAULTS.echo),
    }
    link: BusLink

    def __init__(self, p: Dict[str, Any]) -> None:
        self.link = BusLink(
            settings=BusSettings(**{name: p[name] for name in BusSettings._fields}),
            on_environment=self._publish_environment, logger=LOGGER, **link_arguments(p))
        self.binder = Binder(DESCRIPTION, self.link, p)
        self._environment = publisher('~environment', Environment)
        self._temperature = publisher('~environment/temperature', Temperature)
        self._humidity = publisher('~environment/humidity', RelativeHumidity)
        self._frame_id = p['base_frame_id']
        rospy.Service('~get_environment', GetEnvironment, self._get_environment)
        rospy.Service('~bus/echo', Trigger,
                      lambda _request: self._trigger(wire.ECHO_FUNCTION, os.urandom(4)))
        rospy.Service('~bus/sync', Trigger, lambda _request: self._trigger(wire.SYNC_FUNCTION))
        rospy.Service('~bus/request', BusRequest, self._request)

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

    def _trigger(self, function: wire.Function, *values: bytes) -> TriggerResponse:
        """Call a function; the response's message is the round trip."""
        outcome = self.link.call(function, values)
        response = fill_response(TriggerResponse(), outcome)
        if outcome.success:
            response.message = f'{outcome.round_trip * 1e3:.2f} ms'
        return response

    def _publish_environment(self, reading: wire.Environment, stamp: rospy.Time) -> None:
        message = self._message(reading, stamp)
        self._environment.publish(message)
        self._temperature.publish(message.header, reading.temperature, 0.0)
        self._humidity.publish(message.header, reading.humidity / 100, 0.0)

    def _message(self, reading: wire.Environment, stamp: rospy.Time) -> Environment:
        return Environment(Header(0, stamp, self._frame_id), *reading)


INTERFACE = BusInterface
