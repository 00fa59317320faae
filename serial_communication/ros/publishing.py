"""Publishers with the options that this node needs."""
from typing import Any

import rospy


def publisher(name: str, message_class: Any, **options: Any) -> rospy.Publisher:
    """Return a publisher whose slow subscribers lose messages, but do not delay anybody else.

    Up to 100 messages wait for each subscriber; a newer one replaces the oldest. Small messages
    are sent at once (TCP_NODELAY), without waiting for a subscriber's acknowledgement.
    """
    return rospy.Publisher(name, message_class, queue_size=100, tcp_nodelay=True, **options)


def wanted(topic: rospy.Publisher) -> bool:
    """Return whether the topic has subscribers."""
    return topic.get_num_connections() > 0
