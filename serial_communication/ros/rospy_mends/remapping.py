"""Refuses a remapping that gives two topics of different types one name.

rospy accepts it silently, and messages of one type then fail on the topic of the other.
"""
from typing import Any

import rospy
from rospy.impl import registration

NAME_ERRORS = rospy.ROSException, rospy.ServiceException    # what rospy raises for a name


def install() -> None:
    """Patch rospy: a second type on a topic of this node raises rospy.ROSException."""
    manager = registration.get_topic_manager()
    acquire = manager.acquire_impl

    def acquire_of_one_type(reg_type: str, name: str, message_class: Any) -> Any:
        for other in manager.pubs.get(name), manager.subs.get(name):
            if other is not None and other.data_class._md5sum != message_class._md5sum:
                raise rospy.ROSException(f'topic [{name}] cannot be a {message_class._type}: this '
                                         f'node already uses it as a {other.data_class._type}')
        return acquire(reg_type, name, message_class)

    manager.acquire_impl = acquire_of_one_type


def explained(error: Exception) -> str:
    """Return the error's text, with the remappings if one may have caused it."""
    remapped = [f'{old}:={new}' for old, new in rospy.names.get_mappings().items()
                if not old.startswith('__')]
    if not isinstance(error, NAME_ERRORS) or not remapped:
        return str(error)
    return f'{error}; check the remappings {", ".join(remapped)}'
