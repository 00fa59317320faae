"""The mcu link in ROS: its parameters and its topics."""
from math import inf, nan, pi, radians
from typing import Any, Dict, Optional, Type

import rospy
from sensor_msgs.msg import Range
from std_msgs.msg import Header

from serial_communication.msg import McuStatus, McuStatus2

from ...framing.layout import LayoutMessage
from ...framing.rotation import quaternion
from ...link.link import Link
from ...ros.binder import Binder
from ...ros.imu import ImuTopic
from ...ros.interface import Interface, link_arguments
from ...ros.logs import sparing_log
from ...ros.parameter import MOUNT, RESET_LINE, Parameter, ParameterError, frame_id, seconds
from ...ros.publishing import publisher, wanted
from ...ros.rows import board_parameters
from . import DESCRIPTION, wire
from .session import SensorSession

_NOT_CONNECTED = 0xFFFF   # in place of a reading; no sensor measures it


class McuInterface(Interface):
    """Publishes measurements, and the status of a silent board."""

    NAME = DESCRIPTION.name
    PARAMETERS = {
        **board_parameters(DESCRIPTION),
        'reset_line': RESET_LINE._replace(default='rts'),
        'timeout': seconds(1.0, 0.01, 3600.0),
        'network_silence': seconds(5.0, 0.0, 3600.0),
        'yaw_clockwise': Parameter(True),
        'board_time': Parameter(True),
        'roll_pitch_stdev': Parameter(radians(1.0), 0.0, pi, unit='rad'),
        'yaw_stdev': Parameter(radians(5.0), 0.0, pi, unit='rad'),
        'min_range': Parameter(0.03, 0.0, 65.0, unit='m'),
        'max_range': Parameter(2.0, 0.0, 65.0, unit='m'),
        'field_of_view': Parameter(radians(25.0), 0.0, pi, unit='rad'),
        'imu_frame_id': frame_id('mcu_imu'),
        'imu_orientation_frame_id': frame_id('mcu_imu_orientation'),
        'range_1_frame_id': frame_id('range_1'),
        'range_2_frame_id': frame_id('range_2'),
        'imu_mount': MOUNT,
        'range_1_mount': MOUNT,
        'range_2_mount': MOUNT,
    }
    MOUNTS = ('imu', 'range_1', 'range_2')
    binder: Binder

    def __init__(self, p: Dict[str, Any]) -> None:
        if p['min_range'] >= p['max_range']:
            raise ParameterError(f'parameter {rospy.resolve_name("~mcu/min_range")} is '
                                 f'{p["min_range"]:g} m, has to be less than mcu/max_range, which '
                                 f'is {p["max_range"]:g} m')
        self._turn = -1.0 if p['yaw_clockwise'] else 1.0
        self._ranges = [(publisher(f'mcu/{name}', Range), Range(
            Header(frame_id=p[f'{name}_frame_id']), Range.INFRARED, p['field_of_view'],
            p['min_range'], p['max_range'], nan)) for name in ('range_1', 'range_2')]
        self._status = publisher('mcu/status', McuStatus2)
        self._adc_status = publisher('mcu/adc_status', McuStatus)
        self._imu = ImuTopic('mcu/imu', p)
        self._session = SensorSession(
            sparing_log(self.NAME), p['timeout'], on_status=self._received,
            on_silence=self._silent, network_silence=p['network_silence'])
        self.link = Link(session=self._session, **link_arguments(p))
        self.binder = Binder(DESCRIPTION, self.link, p)

    def _received(self, message: Any, seq: int, stamp: rospy.Time) -> None:
        if message.TYPE not in wire.MESSAGES:
            self.binder.publish(message, stamp)
            return
        now = self.link.now()
        is_adc = type(message) is wire.AdcStatus
        (self._adc_status if is_adc else self._status).publish(
            stamp, seq, True, is_adc or message.valid, self._session.checksum_errors,
            now - (self._session.presence.frame_at or now), *message)
        if is_adc:
            return
        for (topic, out), millimetres in zip(self._ranges, message[:2]):
            if wanted(topic):
                out.header.stamp = stamp
                out.range = _metres(millimetres, out.min_range, out.max_range)
                topic.publish(out)
        if message.angles_known and self._imu.is_wanted:
            self._imu.send(stamp, quaternion(radians(message.roll), radians(message.pitch),
                                             radians(message.yaw) * self._turn))

    def _silent(self, kind: Optional[Type[LayoutMessage]], seq: int, age: float) -> None:
        head = (rospy.Time.now(), seq, False, False, self._session.checksum_errors, age)
        if kind is wire.AdcStatus:
            self._adc_status.publish(*head, *[_NOT_CONNECTED] * 6)
        else:
            self._status.publish(*head, _NOT_CONNECTED, _NOT_CONNECTED, nan, nan, nan)


def _metres(millimetres: int, low: float, high: float) -> float:
    """A range as REP 117 defines it: NaN for no reading, -Inf or +Inf beyond the limits."""
    if millimetres == wire.RANGE_TIMED_OUT:
        return nan
    metres = millimetres / 1000
    return -inf if metres < low else inf if metres > high else metres


INTERFACE = McuInterface
