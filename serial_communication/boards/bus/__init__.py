"""The control board on robot-ctrl-bus: lift, gimbal and environment sensors."""
from typing import Any, Dict, Mapping, Tuple

from ...framing.stream import Decoder
from ..description import CustomRows, Description, Field, Numbering, Service, Topic
from . import wire
from .functions import read_functions


def _decoder(sent: bool, parameters: Mapping[str, Any]) -> Decoder:
    read_functions(parameters.get('functions') or {})      # RowError for a mistake
    return wire.RequestDecoder() if sent else wire.ReplyDecoder(
        bool(parameters.get('reply_has_cmd2')))


# What the forms of some functions show beyond the types of their services.
_FIELDS: Dict[str, Tuple[Field, ...]] = {
    'lift': (Field('distance', 'mm', minimum=1, preset=20),
             Field('direction', choices=(('▲ up', 0), ('▼ down', 1)))),
    'gimbal': (Field('angle', 'deg', minimum=1, preset=10),
               Field('direction', choices=(('◀ left', 0), ('▶ right', 1), ('▲ up', 2),
                                           ('▼ down', 3))))}
# The page shows the environment anyway.
_SHOWN = [*(each for each in wire.BUILT_IN.values() if each.cmd1 == wire.FUNCTION and each.service
            and each is not wire.ENVIRONMENT_FUNCTION), wire.ECHO_FUNCTION, wire.SYNC_FUNCTION]

DESCRIPTION = Description(
    'bus', __name__, _decoder, 'control board',
    topics=(
        Topic('~environment', 'serial_communication/Environment',
              period_parameter='environment_period', card=None),
        Topic('~environment/temperature', 'sensor_msgs/Temperature',
              period_parameter='environment_period', card=None),
        Topic('~environment/humidity', 'sensor_msgs/RelativeHumidity',
              period_parameter='environment_period', card=None)),
    services=tuple(Service(each.service, each.srv_type, each.name, _FIELDS.get(each.name, ()))
                   for each in _SHOWN),
    other_names=('~bus/request', wire.ENVIRONMENT_FUNCTION.service),
    custom=CustomRows('functions', read_functions, '~'),
    wire_flags={'reply_has_cmd2': "replies carry their request's CMD2"},
    numbering=Numbering.FUNCTION,
    question=wire.encode_request(wire.SYNC_REQUEST))
