"""The control board on robot-ctrl-bus: lift, gimbal and environment sensors."""
from typing import Any, Mapping

from ...framing.stream import Decoder
from ..description import Command, CustomRows, Description, Field, Service, Topic
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
              period_parameter='environment_period', card=None),
        Topic('~environment/temperature', 'sensor_msgs/Temperature',
              period_parameter='environment_period', card=None),
        Topic('~environment/humidity', 'sensor_msgs/RelativeHumidity',
              period_parameter='environment_period', card=None)),
    services=(
        Service('~lift', 'serial_communication/Lift', 'lift', (
            Field('distance', 'mm', minimum=1, preset=20),
            Field('direction', choices=(('▲ up', 0), ('▼ down', 1))))),
        Service('~gimbal', 'serial_communication/Gimbal', 'gimbal', (
            Field('angle', 'deg', minimum=1, preset=10),
            Field('direction', choices=(('◀ left', 0), ('▶ right', 1), ('▲ up', 2),
                                        ('▼ down', 3))))),
        Service('~bus/echo', 'std_srvs/Trigger', 'echo'),
        Service('~bus/sync', 'std_srvs/Trigger', 'sync')),
    other_names=('~get_environment', '~bus/request'),
    custom=CustomRows('functions', read_functions, '~'),
    wire_flags={'reply_has_cmd2': "replies carry their request's CMD2"},
    command=Command.FUNCTION,
    question=wire.encode_request(wire.SYNC_REQUEST))
