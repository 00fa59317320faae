"""The mcu link in ROS: its parameters and its topics."""
from math import inf, nan, pi, radians
from typing import Any, Dict, Optional, Type

import rospy
from sensor_msgs.msg import Range
from std_msgs.msg import Header

from serial_communication.msg import McuStatus, McuStatus2

from ...framing.layout import LayoutMessage
from ...framing.rotation import quaternion
from ...framing.rows import RowError
from ...ros.binder import Binder
from ...ros.imu import ImuTopic
from ...ros.logs import sparing_log
from ...ros.parameters import MOUNT, Parameter, frame_id, seconds
from ...ros.publishing import has_subscribers, publisher
from . import DESCRIPTION, wire
from .session import SensorSession

_NOT_CONNECTED = 0xFFFF   # in place of a reading; no sensor measures it


class BoardBinder(Binder):
    """Publishes measurements, and the status of a silent board."""

    BOARD = DESCRIPTION
    PARAMETERS = {
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

    def __init__(self, p: Dict[str, Any]) -> None:
        if p['min_range'] >= p['max_range']:
            raise RowError('mcu/min_range', p['min_range'], 'has to be less than mcu/max_range, '
                           f'which is {p["max_range"]:g} m')
        self._turn = -1.0 if p['yaw_clockwise'] else 1.0
        self._ranges = [(publisher(f'mcu/{name}', Range), Range(
            Header(frame_id=p[f'{name}_frame_id']), Range.INFRARED, p['field_of_view'],
            p['min_range'], p['max_range'], nan)) for name in ('range_1', 'range_2')]
        # By class of message: the topic, and what it has in place of readings.
        self._statuses = {
            wire.SensorStatus: (publisher('mcu/status', McuStatus2),
                                (_NOT_CONNECTED, _NOT_CONNECTED, nan, nan, nan)),
            wire.AdcStatus: (publisher('mcu/adc_status', McuStatus), [_NOT_CONNECTED] * 6)}
        self._imu = ImuTopic('mcu/imu', p)
        self._session = SensorSession(
            sparing_log(DESCRIPTION.name), p['timeout'], on_status=self._received,
            on_silence=self._silent, network_silence=p['network_silence'])
        super().__init__(self._session, p)

    def _received(self, message: Any, seq: int, stamp: rospy.Time) -> None:
        if type(message) not in self._statuses:
            self.publish(message, stamp)
            return
        now, is_adc = self.link.now(), type(message) is wire.AdcStatus
        self._statuses[type(message)][0].publish(
            stamp, seq, True, is_adc or message.valid, self._session.checksum_errors,
            now - (self._session.presence.frame_at or now), *message)
        if is_adc:
            return
        for (topic, out), millimetres in zip(self._ranges, message[:2]):
            if has_subscribers(topic):
                out.header.stamp = stamp
                out.range = _metres(millimetres, out.min_range, out.max_range)
                topic.publish(out)
        if message.angles_known and self._imu.has_subscribers:
            self._imu.send(stamp, quaternion(radians(message.roll), radians(message.pitch),
                                             radians(message.yaw) * self._turn))

    def _silent(self, kind: Optional[Type[LayoutMessage]], seq: int, age: float) -> None:
        topic, readings = self._statuses[kind or wire.SensorStatus]
        topic.publish(rospy.Time.now(), seq, False, False, self._session.checksum_errors, age,
                      *readings)


def _metres(millimetres: int, low: float, high: float) -> float:
    """A range as REP 117 defines it: NaN for no reading, -Inf or +Inf beyond the limits."""
    if millimetres == wire.RANGE_TIMED_OUT:
        return nan
    metres = millimetres / 1000
    return -inf if metres < low else inf if metres > high else metres
