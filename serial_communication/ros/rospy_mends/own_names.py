"""Refuses a name that the node would use twice, after a remapping or because of its own name.

A node named `mcu`, for example, would publish ~imu and mcu/imu on one topic. rospy mixes two
topics of one name silently. If their types differ, messages of one fail on the topic of the other.
"""
from typing import Any, Callable

import rospy
from rospy.impl import registration

from .private_parts import Guard

_GUARD = Guard('rospy.topics:_TopicManager.acquire_impl rospy.service:ServiceManager.register '
               'rospy.service:ServiceManager.get_service', {'08078a8400177e28'},
               'keeps topics and services',
               'two of one name are mixed in silence')
NAME_ERRORS = rospy.ROSException, rospy.ServiceException    # what rospy raises for a name
# Types of topics that are made to be shared: /tf, /tf_static and /diagnostics.
_SHARED = {'tf2_msgs/TFMessage', 'diagnostic_msgs/DiagnosticArray'}


def install(warn: Callable[[str], None]) -> None:
    """Patch rospy, if its source is known: a second use of a name raises one of NAME_ERRORS."""
    if not _GUARD.passes(warn):
        return
    topics, services = registration.get_topic_manager(), registration.get_service_manager()
    acquire, register = topics.acquire_impl, services.register

    def acquire_once(reg_type: str, name: str, message_class: Any) -> Any:
        user = _user(name)
        if user and (user != message_class._type or user not in _SHARED):
            raise rospy.ROSException(_taken(name, message_class._type, user))
        return acquire(reg_type, name, message_class)

    def register_once(name: str, service: Any) -> None:
        user = _user(name)
        if user:
            raise rospy.ServiceException(_taken(name, service.service_class._type, user))
        register(name, service)

    topics.acquire_impl, services.register = acquire_once, register_once


def _user(name: str) -> str:
    """Return the type of this node's topic or service of this name; '' if there is none."""
    topics = registration.get_topic_manager()
    topic = topics.pubs.get(name) or topics.subs.get(name)
    service = registration.get_service_manager().get_service(name)
    return topic.data_class._type if topic else service.service_class._type if service else ''


def _taken(name: str, type_: str, user: str) -> str:
    return (f'{name} cannot be a {type_}: this node already uses the name for a {user}; each of '
            'its topics and services needs its own: give the node another name, or remap one')


def explained(error: Exception) -> str:
    """Return the error's text, with the remappings if one may have caused it."""
    remapped = [f'{old}:={new}' for old, new in rospy.names.get_mappings().items()
                if not old.startswith('__')]
    if not isinstance(error, NAME_ERRORS) or not remapped:
        return str(error)
    return f'{error}; check the remappings {", ".join(remapped)}'
