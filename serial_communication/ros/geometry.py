"""The frames that the sensors stand in, and those that they measure."""
from math import sqrt
from typing import Dict, List, Sequence

import rospy
import tf2_ros
from geometry_msgs.msg import TransformStamped

from ..framing.rotation import quaternion
from .publishing import wanted


def transform(parent: str, child: str, translation: Sequence[float],
              rotation: Sequence[float], stamp: rospy.Time) -> TransformStamped:
    """A transform message; `rotation` as x, y, z, w."""
    message = TransformStamped()
    message.header.stamp = stamp
    message.header.frame_id = parent
    message.child_frame_id = child
    (message.transform.translation.x, message.transform.translation.y,
     message.transform.translation.z) = translation
    (message.transform.rotation.x, message.transform.rotation.y,
     message.transform.rotation.z, message.transform.rotation.w) = rotation
    return message


def publish_mounts(base: str, mounts: Dict[str, List[float]]) -> tf2_ros.StaticTransformBroadcaster:
    """Say once, for good, where each frame stands in `base`: x y z in m, roll pitch yaw in rad.

    The returned broadcaster has to be kept.
    """
    broadcaster = tf2_ros.StaticTransformBroadcaster()
    now = rospy.Time.now()
    broadcaster.sendTransform([transform(base, child, mount[:3], quaternion(*mount[3:]), now)
                               for child, mount in mounts.items()])
    return broadcaster


class OrientationBroadcaster:
    """A measured orientation as a frame of its own, a child of the sensor's frame."""

    def __init__(self, parent: str, child: str) -> None:
        self._broadcaster = tf2_ros.TransformBroadcaster()
        self._parent = parent
        self._child = child

    def send(self, orientation: Sequence[float], stamp: rospy.Time) -> None:
        """Quaternion x, y, z, w, of any length: tf2 takes none whose norm is off by 0.5 %."""
        norm = sqrt(sum(part * part for part in orientation))
        if norm and wanted(self._broadcaster.pub_tf):
            self._broadcaster.sendTransform(transform(
                self._parent, self._child, (0.0, 0.0, 0.0),
                [part / norm for part in orientation], stamp))
