"""The control board on robot-ctrl-bus: lift, gimbal and environment sensors."""
from typing import Any, Mapping

from ...framing.stream import Decoder
from ..description import Command, CustomRows, Description, Topic
from . import wire
from .functions import ANNOUNCEMENT, read_functions


def _decoder(sent: bool, parameters: Mapping[str, Any]) -> Decoder:
    functions = [*read_functions(parameters.get('functions') or {}), ANNOUNCEMENT]
    return wire.RequestDecoder(functions=functions) if sent else wire.ReplyDecoder(
        bool(parameters.get('reply_has_cmd2')), functions=functions)


DESCRIPTION = Description(
    'bus', __name__, _decoder, 'control board',
    topics=(
        Topic('~environment', 'serial_communication/Environment',
              period_parameter='environment_period'),
        Topic('~environment/temperature', 'sensor_msgs/Temperature',
              period_parameter='environment_period'),
        Topic('~environment/humidity', 'sensor_msgs/RelativeHumidity',
              period_parameter='environment_period')),
    other_names=('~lift', '~gimbal', '~get_environment', '~bus/request', '~bus/echo',
                 '~bus/sync'),
    custom=CustomRows('functions', read_functions, '~'),
    wire_flags={'reply_has_cmd2': "replies carry their request's CMD2"},
    command=Command.FUNCTION,
    question=wire.encode_request(wire.SYNC_REQUEST))
