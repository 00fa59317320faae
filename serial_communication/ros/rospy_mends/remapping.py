"""Names of this node that a remapping makes one: rospy takes two topics of different types without
a word, and messages of the one fail on the other."""
from typing import Any

import rospy
from rospy.impl import registration

NAME_ERRORS = rospy.ROSException, rospy.ServiceException    # what rospy raises for a name


def install() -> None:
    """From now on, a topic of this node has one type, whoever publishes it or subscribes."""
    manager = registration.get_topic_manager()
    acquire = manager.acquire_impl

    def acquire_of_one_type(reg_type: str, name: str, message_class: Any) -> Any:
        for other in manager.pubs.get(name), manager.subs.get(name):
            if other is not None and other.data_class._md5sum != message_class._md5sum:
                raise rospy.ROSException(f'topic [{name}] cannot be a {message_class._type}, it is '
                                         f'a {other.data_class._type} of this node already')
        return acquire(reg_type, name, message_class)

    manager.acquire_impl = acquire_of_one_type


def explained(error: Exception) -> str:
    """What is wrong with a name, and how it may have come to be so."""
    remapped = [f'{old}:={new}' for old, new in rospy.names.get_mappings().items()
                if not old.startswith('__')]
    if not isinstance(error, NAME_ERRORS) or not remapped:
        return str(error)
    return f'{error}; remapped are {", ".join(remapped)}'
