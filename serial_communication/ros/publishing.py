"""Publishers with the options that this node needs, and transforms of tf."""
from math import isfinite, sqrt
from typing import Any, Dict, List, Sequence

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


def has_subscribers(topic: rospy.Publisher) -> bool:
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


class MessageTopic:
    """A topic whose message is filled in anew each time, and whose pose may be on /tf, too.

    Args:
        pose: a geometry_msgs/Pose, in the message or beside it, in the frame of its header; None:
            nothing is published on /tf.
        child: the frame that has this pose.
    """

    def __init__(self, name: str, message: Any, pose: Any = None, child: str = '') -> None:
        self.message = message
        self.topics = [publisher(name, type(message))]
        self._pose, self._child = pose, child
        if pose:
            self.topics.append(publisher('/tf', TFMessage))

    @property
    def has_subscribers(self) -> bool:
        """Whether anybody subscribes to the topic, or to the pose."""
        return any(map(has_subscribers, self.topics))

    def publish(self, stamp: rospy.Time) -> None:
        """Publish the message, and the pose, whose quaternion has any length but 0.

        A pose that tf2 would refuse, with NaN or infinity, is left out.
        """
        if self.message._has_header:
            self.message.header.stamp = stamp
        self.topics[0].publish(self.message)
        if not self._pose or not has_subscribers(self.topics[1]):
            return
        position, rotation = self._pose.position, self._pose.orientation
        at = position.x, position.y, position.z
        turn = rotation.x, rotation.y, rotation.z, rotation.w
        norm = sqrt(sum(part * part for part in turn))
        if norm and all(map(isfinite, (norm, *at))):
            # tf2 refuses a quaternion whose length is 0.5 % wrong.
            self.topics[1].publish(TFMessage([_transform(
                self.message.header.frame_id, self._child, at, [part / norm for part in turn],
                stamp)]))
