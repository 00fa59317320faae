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
from ...ros.answers import fill_response
from ...ros.binder import Binder
from ...ros.interface import Interface, link_arguments
from ...ros.logs import sparing_log
from ...ros.parameter import Parameter, seconds
from ...ros.publishing import publisher
from ...ros.rows import board_parameters
from . import DESCRIPTION, wire
from .call import MasterOptions
from .link import BusLink
from .session import MasterSession

_DEFAULTS = MasterOptions()


class BusInterface(Interface):
    """Offers services and publishes readings."""

    NAME = DESCRIPTION.name
    PARAMETERS = {
        **board_parameters(DESCRIPTION, _DEFAULTS.announcements),
        'reply_timeout': seconds(_DEFAULTS.reply_timeout, 0.01, 60.0),
        'motion_timeout': seconds(_DEFAULTS.motion_timeout, 0.01, 600.0),
        'retries': Parameter(_DEFAULTS.retries, 0, 100),
        'environment_period': seconds(1.0, 0.0, 86400.0),
        'environment_datelen': Parameter(_DEFAULTS.environment_datelen, choices=(0, 2)),
        'reply_has_cmd2': Parameter(_DEFAULTS.reply_has_cmd2),
        'echo': Parameter(_DEFAULTS.echo),
    }
    link: BusLink

    def __init__(self, p: Dict[str, Any]) -> None:
        session = MasterSession(sparing_log(self.NAME), MasterOptions(
            **{name: p[name] for name in MasterOptions._fields}))
        if p['environment_period']:
            session.polls.add(wire.ENVIRONMENT_FUNCTION, p['environment_period'],
                              self._publish_environment)
        self.link = BusLink(session=session, **link_arguments(p))
        self.binder = Binder(DESCRIPTION, self.link, p)
        self._environment = publisher('~environment', Environment)
        self._temperature = publisher('~environment/temperature', Temperature)
        self._humidity = publisher('~environment/humidity', RelativeHumidity)
        self._frame_id = p['base_frame_id']
        rospy.Service('~get_environment', GetEnvironment, self._get_environment)
        rospy.Service('~bus/echo', Trigger, self._echo)
        rospy.Service('~bus/sync', Trigger, self._sync)
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

    def _echo(self, _request: Any) -> TriggerResponse:
        outcome = self.link.request(wire.echo(os.urandom(4)), wire.ECHO_FUNCTION)
        return self._trigger(outcome, f'{outcome.round_trip * 1e3:.2f} ms')

    def _sync(self, _request: Any) -> TriggerResponse:
        outcome = self.link.request(wire.SYNC_REQUEST, wire.SYNC_FUNCTION)
        return self._trigger(outcome, 'synchronised')

    @staticmethod
    def _trigger(outcome: Outcome, done: str) -> TriggerResponse:
        response = fill_response(TriggerResponse(), outcome)
        if outcome.success:
            response.message = done
        return response

    def _publish_environment(self, outcome: Outcome) -> None:
        message = self._message(outcome)
        self._environment.publish(message)
        self._temperature.publish(message.header, message.temperature, 0.0)
        self._humidity.publish(message.header, message.humidity / 100, 0.0)

    def _message(self, outcome: Outcome) -> Environment:
        header = Header(0, outcome.stamp, self._frame_id)
        return Environment(header, *wire.Environment.unpack(outcome.data))


INTERFACE = BusInterface
