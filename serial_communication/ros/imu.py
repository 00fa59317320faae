"""An IMU's messages, and its orientation on /tf."""
import struct
from typing import Any, Dict, List, Optional, Sequence

import rospy
from geometry_msgs.msg import Pose
from sensor_msgs.msg import Imu

from .publishing import MessageTopic

_HEAD = struct.Struct('<4I')        # seq, stamp, length of frame_id
_NUMBERS = struct.Struct('<37d')
_NOT_MEASURED = [-1.0] + [0.0] * 8      # a covariance, as sensor_msgs/Imu defines it


class PackedImu(Imu):
    """An Imu that is serialized to the same bytes, but in one step instead of eight."""

    def serialize(self, buff: Any) -> None:
        header, at, rate, acceleration = (self.header, self.orientation, self.angular_velocity,
                                          self.linear_acceleration)
        frame_id = header.frame_id.encode()
        buff.write(_HEAD.pack(header.seq, header.stamp.secs, header.stamp.nsecs, len(frame_id))
                   + frame_id + _NUMBERS.pack(
                       at.x, at.y, at.z, at.w, *self.orientation_covariance,
                       rate.x, rate.y, rate.z, *self.angular_velocity_covariance,
                       acceleration.x, acceleration.y, acceleration.z,
                       *self.linear_acceleration_covariance))


class ImuTopic(MessageTopic):
    """Publishes an IMU's messages, and its orientation on /tf if the parameters say so.

    Args:
        rate: standard deviation in rad/s; None: not measured.
        acceleration: standard deviation in m/s^2; None: not measured.
    """

    def __init__(self, name: str, p: Dict[str, Any], rate: Optional[float] = None,
                 acceleration: Optional[float] = None) -> None:
        message, level = PackedImu(), p['roll_pitch_stdev']
        super().__init__(name, message, Pose(orientation=message.orientation)
                         if p['publish_tf'] else None, p['imu_orientation_frame_id'])
        message.header.frame_id = p['imu_frame_id']
        message.orientation_covariance = _covariance(level, level, p['yaw_stdev'])
        message.angular_velocity_covariance = \
            _NOT_MEASURED if rate is None else _covariance(rate, rate, rate)
        message.linear_acceleration_covariance = \
            _NOT_MEASURED if acceleration is None else _covariance(*[acceleration] * 3)

    def send(self, stamp: rospy.Time, orientation: Sequence[float],
             rate: Sequence[float] = (0.0, 0.0, 0.0),
             acceleration: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        """Publish an orientation (x, y, z, w), a rate in rad/s and an acceleration in m/s^2."""
        message = self.message
        at, turn, force = (message.orientation, message.angular_velocity,
                           message.linear_acceleration)
        at.x, at.y, at.z, at.w = orientation
        turn.x, turn.y, turn.z = rate
        force.x, force.y, force.z = acceleration
        self.publish(stamp)


def _covariance(x: float, y: float, z: float) -> List[float]:
    """Return the covariance matrix for these standard deviations, in row-major order."""
    return [x ** 2, 0.0, 0.0, 0.0, y ** 2, 0.0, 0.0, 0.0, z ** 2]
