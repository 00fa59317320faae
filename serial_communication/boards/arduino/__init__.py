"""The model car's Arduino Nano: COBS packets, and a heartbeat that keeps the motor running."""
from typing import Any, Mapping

from ...framing.layout import Layout, Value
from ...framing.row_reader import Group
from ...framing.rows import Kind, Row, Setting
from ...framing.stream import SETTING, Decoder
from ..description import Description, Service, Topic
from . import wire


def _decoder(sent: bool, parameters: Mapping[str, Any]) -> Decoder:
    rows = DESCRIPTION.read_all(parameters)
    kinds = [row.message for row in rows
             if row.kind in (Kind.TO if sent else Kind.FROM, Kind.SETTING)]
    return wire.BoardDecoder(messages=kinds) if sent else wire.Decoder(messages=kinds)


def _row(name: str, kind: Kind, message: Any, ros_type: str, **more: Any) -> Row:
    return Row(name, message.TYPE, kind, **{'layout': message.LAYOUT, **more}, ros_type=ros_type,
               message=message)


LONGEST_GAP = 0.03     # s between heartbeats
DESCRIPTION = Description(
    'arduino', __name__, _decoder, 'model car',
    rows=(
        _row('voltage', Kind.FROM, wire.Voltage, 'serial_communication/Voltage', period=1.0),
        _row('ticks', Kind.FROM, wire.Ticks, 'serial_communication/Ticks', period=0.01),
        _row('steering_angle', Kind.FROM, wire.SteeringAngle,
             'serial_communication/SteeringFeedback', period=0.01),
        _row('speed', Kind.TO, wire.SpeedCommand, 'serial_communication/SpeedPWMCommand',
             motion=True, newest=True, layout=Layout('<h', [
                 Value('value', minimum=-wire.SPEED_LIMIT, maximum=wire.SPEED_LIMIT)])),
        _row('steering', Kind.TO, wire.SteeringCommand,
             'serial_communication/SteeringPWMCommand', newest=True),
        _row('led', Kind.TO, wire.LedCommand, 'std_msgs/String',
             layout=Layout('<s', [Value('data')]))),
    groups=(
        Group('messages', '~', (Kind.FROM, Kind.TO),
              [type_ for type_ in range(SETTING) if type_ not in wire.BUILT_IN],
              wire.MAX_PACKET - 1),
        Group('settings', '~settings/arduino/', (Kind.SETTING,), make=Setting)),
    topics=(
        Topic('~imu', 'sensor_msgs/Imu', 0.01),
        Topic('~imu/temperature', 'sensor_msgs/Temperature', 0.01),
        Topic('~imu/calibrating', 'std_msgs/Bool', ages=False)),
    services=(Service('~calibrate_imu', 'std_srvs/Empty', 'calibrate the IMU', confirm=(
        'The car must not move for over five minutes. During that time it takes no commands and '
        'sends no IMU data.')),
        Service('~arduino/reset', 'std_srvs/Trigger', 'reset the car', confirm=(
            'The car stops, and its board starts anew.'))),
    longest_gap=LONGEST_GAP,
    reset_line='dtr',
    between=b'\0')
