"""The ESP32 with two range sensors and an IMU, or with ADC channels."""
from typing import Any, List, Mapping

from ...framing.custom_messages import RESERVED, CustomMessage, read_messages
from ...framing.settings import Setting, message_of, read_settings
from ...framing.stream import Decoder
from ..description import CustomRows, Description, Service, Topic
from . import wire

_STATUS = 1.0     # s; the longest period: the status of a silent board is published once a second


def custom_messages(entries: Any, key: str = 'mcu/messages') -> List[CustomMessage]:
    """The custom messages in the parameter `key`; RowError for the first mistake in them."""
    free = [type_ for type_ in range(RESERVED) if type_ not in wire.BUILT_IN]
    return read_messages(entries, key, free, wire.MAX_PAYLOAD)


def settings(entries: Any, key: str = 'mcu/settings') -> List[Setting]:
    """The settings in the parameter `key`; RowError for the first mistake in them."""
    return read_settings(entries, key)


def _decoder(_sent: bool, parameters: Mapping[str, Any]) -> Decoder:
    # The board reads settings alone, and these have one format in both directions.
    return wire.Decoder([*(each.kind for each in custom_messages(parameters.get('messages') or {})),
                         message_of(settings(parameters.get('settings') or {}))])


DESCRIPTION = Description(
    'mcu', __name__, _decoder, 'sensor board',
    topics=(
        Topic('mcu/status', 'serial_communication/McuStatus2', _STATUS, card='Ranges'),
        Topic('mcu/adc_status', 'serial_communication/McuStatus', _STATUS, optional=True,
              card='Channels'),
        Topic('mcu/imu', 'sensor_msgs/Imu', card=None),
        Topic('mcu/range_1', 'sensor_msgs/Range', card='Ranges'),
        Topic('mcu/range_2', 'sensor_msgs/Range', card='Ranges')),
    services=(Service('~mcu/reset', 'std_srvs/Trigger', 'reset the sensor board', confirm=(
        'The board starts anew; its measurements are missing until then.')),),
    custom=CustomRows('messages', custom_messages, 'mcu/'),
    settings=CustomRows('settings', settings, '~settings/mcu/'))
