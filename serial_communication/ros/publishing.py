"""Publishers with the options that this node needs, and transforms of tf."""
from math import isfinite, sqrt
from typing import Any, Dict, List, Optional, Sequence, Tuple

import rospy
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from ..framing.rotation import quaternion


def publisher(name: str, message_class: Any, **options: Any) -> rospy.Publisher:
    """Return a publisher whose slow subscribers lose messages, but do not delay anybody else.

    Up to 100 messages wait for each subscriber; a newer one replaces the oldest. Small messages
    are sent at once (TCP_NODELAY), without waiting for a subscriber's acknowledgement.
    """
    return rospy.Publisher(name, message_class, queue_size=100, tcp_nodelay=True, **options)


def wanted(topic: rospy.Publisher) -> bool:
    """Return whether the topic has subscribers."""
    return topic.get_num_connections() > 0


def _transform(parent: str, child: str, translation: Sequence[float],
               rotation: Sequence[float], stamp: rospy.Time) -> TransformStamped:
    return TransformStamped(Header(0, stamp, parent), child,
                            Transform(Vector3(*translation), Quaternion(*rotation)))


def publish_mounts(base: str, mounts: Dict[str, List[float]]) -> None:
    """Publish each frame's static transform in `base`: x y z in m, roll pitch yaw in rad."""
    now = rospy.Time.now()
    publisher('/tf_static', TFMessage, latch=True).publish(TFMessage([
        _transform(base, child, mount[:3], quaternion(*mount[3:]), now)
        for child, mount in mounts.items()]))


class PoseTopic:
    """A topic whose messages may have a pose, which is published on /tf, too.

    Args:
        frames: parent and child of the pose; None: nothing is published on /tf.
    """

    def __init__(self, name: str, message_class: Any,
                 frames: Optional[Tuple[str, str]] = None) -> None:
        self._frames = frames
        self._topics = [publisher(name, message_class)]
        if frames:
            self._topics.append(publisher('/tf', TFMessage))

    @property
    def is_wanted(self) -> bool:
        """Whether anybody subscribes to the topic, or to the pose."""
        return any(map(wanted, self._topics))

    def publish(self, message: Any, stamp: rospy.Time, pose: Any) -> None:
        """Publish a message, and its geometry_msgs/Pose, whose quaternion has any length but 0.

        A pose that tf2 would refuse, with NaN or infinity, is left out.
        """
        self._topics[0].publish(message)
        if not self._frames or not wanted(self._topics[1]):
            return
        at = pose.position.x, pose.position.y, pose.position.z
        rotation = pose.orientation
        turn = rotation.x, rotation.y, rotation.z, rotation.w
        norm = sqrt(sum(part * part for part in turn))
        if norm and all(map(isfinite, (norm, *at))):
            # tf2 refuses a quaternion whose length is 0.5 % wrong.
            self._topics[1].publish(TFMessage([_transform(
                *self._frames, at, [part / norm for part in turn], stamp)]))

    def close(self) -> None:
        """Unregister."""
        for topic in self._topics:
            topic.unregister()
