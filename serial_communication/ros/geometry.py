"""Transforms of tf."""
from math import isfinite, sqrt
from typing import Dict, List, Sequence

import rospy
import tf2_ros
from geometry_msgs.msg import TransformStamped

from ..framing.rotation import quaternion
from .publishing import wanted


def transform(parent: str, child: str, translation: Sequence[float],
              rotation: Sequence[float], stamp: rospy.Time) -> TransformStamped:
    """Return a transform message; `translation` in m, `rotation` a quaternion x, y, z, w."""
    message = TransformStamped(child_frame_id=child)
    message.header.stamp, message.header.frame_id = stamp, parent
    at, turn = message.transform.translation, message.transform.rotation
    at.x, at.y, at.z = translation
    turn.x, turn.y, turn.z, turn.w = rotation
    return message


def publish_mounts(base: str, mounts: Dict[str, List[float]]) -> tf2_ros.StaticTransformBroadcaster:
    """Publish each frame's static transform in `base`: x y z in m, roll pitch yaw in rad.

    The transforms last as long as the returned broadcaster.
    """
    broadcaster = tf2_ros.StaticTransformBroadcaster()
    now = rospy.Time.now()
    broadcaster.sendTransform([transform(base, child, mount[:3], quaternion(*mount[3:]), now)
                               for child, mount in mounts.items()])
    return broadcaster


class FrameBroadcaster:
    """Publishes where a frame is in its parent frame on /tf, while somebody subscribes to that."""

    def __init__(self, parent: str, child: str) -> None:
        self._frames = parent, child
        self._broadcaster = tf2_ros.TransformBroadcaster()

    @property
    def is_wanted(self) -> bool:
        """Whether anything would be published."""
        return wanted(self._broadcaster.pub_tf)

    def send(self, translation: Sequence[float], rotation: Sequence[float],
             stamp: rospy.Time) -> None:
        """Publish it: x y z in m, and a quaternion x y z w of any length but 0.

        What tf2 would refuse, NaN or infinity, is left out.
        """
        norm = sqrt(sum(part * part for part in rotation))
        if self.is_wanted and norm and all(map(isfinite, (norm, *translation))):
            # tf2 refuses a quaternion whose length is 0.5 % wrong.
            self._broadcaster.sendTransform(transform(
                *self._frames, translation, [part / norm for part in rotation], stamp))

    def close(self) -> None:
        """Unregister from /tf."""
        self._broadcaster.pub_tf.unregister()
