"""The arduino link in ROS: its parameters, its topics and its service."""
from math import pi, radians
from typing import Any, Dict

import rospy
from sensor_msgs.msg import Temperature
from std_msgs.msg import Bool, Header
from std_srvs.srv import Empty, EmptyResponse

from ...link.outcome import Refused
from ...ros.binder import Binder
from ...ros.imu import ImuTopic
from ...ros.logs import sparing_log
from ...ros.parameters import MOUNT, Parameter, frame_id, seconds
from ...ros.publishing import has_subscribers, publisher
from . import DESCRIPTION, wire
from .session import CarOptions, CarSession

_DEFAULTS = CarOptions()
_LOG_FUNCTIONS = (rospy.logdebug, rospy.loginfo, rospy.logwarn, rospy.logerr)    # by severity


class BoardBinder(Binder):
    """Publishes the measurements that no row describes, and calibrates."""

    BOARD = DESCRIPTION
    PARAMETERS = {
        'reset_on_open': Parameter(False),
        # At 34 Hz a heartbeat is sent every 29 ms; the board stops its motor after 30 ms without.
        'heartbeat_rate': Parameter(_DEFAULTS.heartbeat_rate, 34.0, 1000.0, unit='Hz'),
        'speed_timeout': seconds(_DEFAULTS.speed_timeout, 0.0, 3600.0),
        'command_age': seconds(0.5, 0.0, 3600.0),
        'network_silence': seconds(_DEFAULTS.network_silence, 0.0, 3600.0),
        'calibration_timeout': seconds(_DEFAULTS.calibration_timeout, 1.0, 86400.0),
        'check_plausibility': Parameter(_DEFAULTS.check_plausibility),
        'board_time': Parameter(True),
        'gyro_scale': Parameter(wire.GYRO_SCALE, -1.0, 1.0, unit='rad/s per LSB'),
        'linear_acceleration_stdev': Parameter(400e-6 * 9.807, 0.0, 1e3, unit='m/s^2'),
        'angular_velocity_stdev': Parameter(radians(0.05), 0.0, 1e3, unit='rad/s'),
        'roll_pitch_stdev': Parameter(radians(1.0), 0.0, pi, unit='rad'),
        'yaw_stdev': Parameter(radians(5.0), 0.0, pi, unit='rad'),
        'imu_frame_id': frame_id('imu'),
        'imu_orientation_frame_id': frame_id('imu_orientation'),
        'imu_mount': MOUNT,
    }

    def __init__(self, p: Dict[str, Any]) -> None:
        self._gyro_scale = p['gyro_scale']
        self._imu = ImuTopic('~imu', p, p['angular_velocity_stdev'],
                             p['linear_acceleration_stdev'])
        self._temperature = publisher('~imu/temperature', Temperature)
        self._frame_id = p['imu_frame_id']
        self._calibrating = publisher('~imu/calibrating', Bool, latch=True)
        self._calibrating.publish(False)
        options = CarOptions(**{name: p[name] for name in CarOptions._fields})
        super().__init__(CarSession(
            sparing_log(DESCRIPTION.name), options, on_message=self._received,
            on_log=lambda severity, text: _LOG_FUNCTIONS[severity]('arduino says: %s', text),
            on_calibrating=self._calibrating.publish), p)
        rospy.Service('~calibrate_imu', Empty, self._calibrate)

    def _calibrate(self, _request: Any) -> EmptyResponse:
        try:
            self.link.writer.submit(wire.ImuCalibration())
        except Refused as refused:
            raise rospy.ServiceException(str(refused)) from None
        return EmptyResponse()

    def _received(self, message: Any, stamp: rospy.Time) -> None:
        if type(message) is not wire.Imu:
            self.publish(message, stamp)
            return
        if self._imu.has_subscribers:
            self._imu.send(stamp, message.orientation(),
                           message.angular_velocity(self._gyro_scale),
                           message.linear_acceleration())
        if has_subscribers(self._temperature):
            self._temperature.publish(Header(0, stamp, self._frame_id), message.temperature(), 0.0)
