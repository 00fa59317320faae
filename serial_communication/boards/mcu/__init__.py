"""The ESP32 with two range sensors and an IMU, or with ADC channels."""
from typing import Any, Mapping

from ...framing.row_reader import Group
from ...framing.rows import Kind, Setting
from ...framing.stream import SETTING, Decoder
from ..description import Description, Service, Topic
from . import wire

_STATUS = 1.0     # s; the longest period: the status of a silent board is published once a second


def _decoder(_sent: bool, parameters: Mapping[str, Any]) -> Decoder:
    # The board reads settings alone, and these have one format in both directions.
    return wire.Decoder(row.message for row in DESCRIPTION.read_all(parameters))


DESCRIPTION = Description(
    'mcu', __name__, _decoder, 'sensor board',
    groups=(
        Group('messages', 'mcu/', (Kind.FROM,),
              [type_ for type_ in range(SETTING) if type_ not in wire.BUILT_IN],
              wire.MAX_PAYLOAD),
        Group('settings', '~settings/mcu/', (Kind.SETTING,), make=Setting)),
    topics=(
        Topic('mcu/status', 'serial_communication/McuStatus2', _STATUS),
        Topic('mcu/adc_status', 'serial_communication/McuStatus', _STATUS, optional=True),
        Topic('mcu/imu', 'sensor_msgs/Imu'),
        Topic('mcu/range_1', 'sensor_msgs/Range'),
        Topic('mcu/range_2', 'sensor_msgs/Range')),
    services=(Service('~mcu/reset', 'std_srvs/Trigger', 'reset the sensor board', confirm=(
        'The board starts anew; its measurements are missing until then.')),),
    reset_line='rts')
