"""The model car's Arduino Nano: COBS packets, and a heartbeat that keeps the motor running."""
from typing import Any, List, Mapping

from ...framing.custom_messages import (FROM_BOARD, RESERVED, TO_BOARD, CustomMessage,
                                        read_messages)
from ...framing.settings import Setting, message_of, read_settings
from ...framing.stream import Decoder
from ..description import CustomRows, Description, Heartbeat, Service, Topic
from . import wire


def custom_messages(entries: Any, key: str = 'arduino/messages') -> List[CustomMessage]:
    """The custom messages in the parameter `key`; RowError for the first mistake in them."""
    free = [type_ for type_ in range(RESERVED) if type_ not in wire.BUILT_IN]
    return read_messages(entries, key, free, wire.MAX_PACKET - 1, (FROM_BOARD, TO_BOARD))


def settings(entries: Any, key: str = 'arduino/settings') -> List[Setting]:
    """The settings in the parameter `key`; RowError for the first mistake in them."""
    return read_settings(entries, key)


def _decoder(sent: bool, parameters: Mapping[str, Any]) -> Decoder:
    kinds = [each.kind for each in custom_messages(parameters.get('messages') or {})
             if each.is_command == sent]
    kinds.append(message_of(settings(parameters.get('settings') or {})))
    return wire.BoardDecoder(messages=kinds) if sent else wire.Decoder(messages=kinds)


LONGEST_GAP = 0.03     # s between heartbeats
DESCRIPTION = Description(
    'arduino', __name__, _decoder, 'model car',
    topics=(
        Topic('~imu', 'sensor_msgs/Imu', 0.01, card=None),
        Topic('~imu/temperature', 'sensor_msgs/Temperature', 0.01, card=None),
        Topic('~imu/calibrating', 'std_msgs/Bool', ages=False, card=None),
        Topic('~voltage', 'serial_communication/Voltage', 1.0, card=None, message=wire.Voltage),
        Topic('~ticks', 'serial_communication/Ticks', 0.01, card=None, message=wire.Ticks),
        Topic('~steering_angle', 'serial_communication/SteeringFeedback', 0.01, card=None,
              message=wire.SteeringAngle)),
    services=(Service('~calibrate_imu', 'std_srvs/Empty', 'calibrate the IMU', confirm=(
        'The car must not move for over five minutes. During that time it takes no commands and '
        'sends no IMU data.')),
        Service('~arduino/reset', 'std_srvs/Trigger', 'reset the car', confirm=(
            'The car stops, and its board starts anew.'))),
    other_names=('~speed', '~steering', '~led'),
    custom=CustomRows('messages', custom_messages, '~'),
    settings=CustomRows('settings', settings, '~settings/arduino/'),
    heartbeat=Heartbeat(wire.Heartbeat.TYPE, LONGEST_GAP),
    between=b'\0',
    network_silence=1.0)
