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

from ...link.outcome import Outcome
from ...ros.fields import fill_response
from ...ros.binder import Binder
from ...ros.logs import sparing_log
from ...ros.parameters import Parameter, seconds
from ...ros.publishing import publisher
from . import DESCRIPTION, wire
from .call import MasterOptions
from .link import BusLink
from .session import MasterSession

_DEFAULTS = MasterOptions()


class BoardBinder(Binder):
    """Offers services and publishes readings."""

    BOARD = DESCRIPTION
    LINK = BusLink
    PARAMETERS = {
        'announcements': Parameter(_DEFAULTS.announcements),
        'reply_timeout': seconds(_DEFAULTS.reply_timeout, 0.01, 60.0),
        'motion_timeout': seconds(_DEFAULTS.motion_timeout, 0.01, 600.0),
        'retries': Parameter(_DEFAULTS.retries, 0, 100),
        'environment_period': seconds(1.0, 0.0, 86400.0),
        'environment_datelen': Parameter(_DEFAULTS.environment_datelen, choices=(0, 2)),
        'reply_has_cmd2': Parameter(_DEFAULTS.reply_has_cmd2),
        'echo': Parameter(_DEFAULTS.echo),
    }

    def __init__(self, p: Dict[str, Any]) -> None:
        session = MasterSession(sparing_log(DESCRIPTION.name), MasterOptions(
            **{name: p[name] for name in MasterOptions._fields}))
        if p['environment_period']:
            session.polls.add(wire.ENVIRONMENT_FUNCTION, p['environment_period'],
                              self._publish_environment)
        super().__init__(session, p)
        self._environment = publisher('~environment', Environment)
        self._temperature = publisher('~environment/temperature', Temperature)
        self._humidity = publisher('~environment/humidity', RelativeHumidity)
        self._frame_id = p['base_frame_id']
        rospy.Service('~get_environment', GetEnvironment, self._get_environment)
        rospy.Service('~bus/echo', Trigger, lambda _request: self._trigger(
            wire.echo(os.urandom(4)), wire.ECHO_FUNCTION))
        rospy.Service('~bus/sync', Trigger, lambda _request: self._trigger(
            wire.SYNC_REQUEST, wire.SYNC_FUNCTION))
        rospy.Service('~bus/request', BusRequest, self._request)

    def _get_environment(self, _request: Any) -> GetEnvironmentResponse:
        outcome = self.link.request(wire.ENVIRONMENT_REQUEST, wire.ENVIRONMENT_FUNCTION,
                                    self._publish_environment)
        response = fill_response(GetEnvironmentResponse(), outcome)
        if outcome.success:
            response.environment = self._message(outcome)
            response.message = f'done: {wire.Environment.unpack(outcome.data)}'
        return response

    def _request(self, request: Any) -> BusRequestResponse:
        outcome = self.link.request(wire.Request(request.cmd1, request.cmd2,
                                                 bytes(request.data)))
        response = fill_response(BusRequestResponse(), outcome)
        response.data = outcome.data
        return response

    def _trigger(self, request: wire.Request, function: wire.Function) -> TriggerResponse:
        outcome = self.link.request(request, function)
        response = fill_response(TriggerResponse(), outcome)
        if outcome.success:
            response.message = f'{outcome.round_trip * 1e3:.2f} ms'
        return response

    def _publish_environment(self, outcome: Outcome) -> None:
        message = self._message(outcome)
        self._environment.publish(message)
        self._temperature.publish(message.header, message.temperature, 0.0)
        self._humidity.publish(message.header, message.humidity / 100, 0.0)

    def _message(self, outcome: Outcome) -> Environment:
        header = Header(0, outcome.stamp, self._frame_id)
        return Environment(header, *wire.Environment.unpack(outcome.data))
