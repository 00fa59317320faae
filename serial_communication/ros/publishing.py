"""Publishers as this node uses them."""
import rospy


def publisher(name: str, message_class, **options) -> rospy.Publisher:
    """A publisher whose slow subscribers lose messages and hold up nobody.

    A hundred messages queue for each subscriber; what comes then pushes the oldest out. Small
    messages leave at once instead of waiting for a subscriber's acknowledgement.
    """
    return rospy.Publisher(name, message_class, queue_size=100, tcp_nodelay=True, **options)


def wanted(topic: rospy.Publisher) -> bool:
    """Whether anybody subscribes; asked for every message, so without rospy's lock."""
    return bool(topic.impl.connections)


def diagonal(x: float, y: float, z: float) -> list:
    """A covariance matrix, row by row."""
    return [x, 0.0, 0.0, 0.0, y, 0.0, 0.0, 0.0, z]
