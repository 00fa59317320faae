"""The control board on robot-ctrl-bus: lift, gimbal and environment sensors."""
from typing import Any, Mapping, Tuple

from ...framing.stream import Decoder
from ..description import Command, CustomRows, Description, Field, Service, Topic
from . import wire
from .functions import read_functions


def _decoder(sent: bool, parameters: Mapping[str, Any]) -> Decoder:
    functions = read_functions(parameters.get('functions') or {})
    return wire.RequestDecoder(functions=functions) if sent else wire.ReplyDecoder(
        bool(parameters.get('reply_has_cmd2')), functions=functions)


def _service(function: wire.Function, fields: Tuple[Field, ...] = ()) -> Service:
    return Service(function.service, function.srv_type, function.name, fields)


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
        _service(wire.LIFT_FUNCTION, (
            Field('distance', 'mm', minimum=1, preset=20),
            Field('direction', choices=(('▲ up', 0), ('▼ down', 1))))),
        _service(wire.GIMBAL_FUNCTION, (
            Field('angle', 'deg', minimum=1, preset=10),
            Field('direction', choices=(('◀ left', 0), ('▶ right', 1), ('▲ up', 2),
                                        ('▼ down', 3))))),
        _service(wire.ECHO_FUNCTION), _service(wire.SYNC_FUNCTION)),
    other_names=('~bus/request', *(each.service for each in wire.BUILT_IN.values()
                                   if each.service)),
    custom=CustomRows('functions', read_functions, '~'),
    wire_flags={'reply_has_cmd2': "replies carry their request's CMD2"},
    command=Command.FUNCTION,
    question=wire.encode_request(wire.SYNC_REQUEST))
