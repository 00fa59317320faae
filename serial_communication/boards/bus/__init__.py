"""The control board on robot-ctrl-bus: lift, gimbal and environment sensors."""
from typing import Any, Mapping

from ...framing.row_reader import Group
from ...framing.rows import Kind
from ...framing.stream import Decoder
from ..description import Description, Field, Service, Topic
from . import wire


def _decoder(sent: bool, parameters: Mapping[str, Any]) -> Decoder:
    DESCRIPTION.read_all(parameters)      # RowError for a mistake
    return wire.RequestDecoder() if sent else wire.ReplyDecoder(
        bool(parameters.get('reply_has_cmd2')))


DESCRIPTION = Description(
    'bus', __name__, _decoder, 'control board',
    rows=(wire.LIFT_FUNCTION, wire.GIMBAL_FUNCTION),
    groups=(Group(
        'functions', '~', (Kind.FUNCTION,),
        [cmd2 for cmd2 in range(wire.ANNOUNCEMENT.number)
         if (wire.FUNCTION, cmd2) not in wire.BUILT_IN], wire.MAX_LENGTH, wire.Function),),
    topics=tuple(Topic(name, type_, period_parameter='environment_period')
                 for name, type_ in (
                     ('~environment', 'serial_communication/Environment'),
                     ('~environment/temperature', 'sensor_msgs/Temperature'),
                     ('~environment/humidity', 'sensor_msgs/RelativeHumidity'))),
    services=(      # the page shows the environment anyway
        Service('~lift', wire.LIFT_FUNCTION.ros_type, 'lift', (
            Field('distance', 'mm', minimum=1, preset=20),
            Field('direction', choices=(('▲ up', 0), ('▼ down', 1))))),
        Service('~gimbal', wire.GIMBAL_FUNCTION.ros_type, 'gimbal', (
            Field('angle', 'deg', minimum=1, preset=10),
            Field('direction', choices=(('◀ left', 0), ('▶ right', 1), ('▲ up', 2),
                                        ('▼ down', 3))))),
        Service('~bus/echo', 'std_srvs/Trigger', 'echo'),
        Service('~bus/sync', 'std_srvs/Trigger', 'sync')),
    other_names=('~bus/request', '~get_environment'),
    question=wire.encode_request(wire.SYNC_REQUEST))
