"""Registers the node again at a ROS master that has come new: rospy does so at start alone.

After roscore was restarted, its successor knows none of the nodes that live on. Peers that are
connected stay so, but nobody finds the node's topics, services and parameters any more.
"""
import logging
import threading
import xmlrpc.client
from typing import Any, Dict, Optional, Tuple

import rosgraph
import rospy
from rospy.impl import registration

_PERIOD = 3.0     # s from one look at the master to the next
_TIMEOUT = 2.0    # s for each of its answers


class _Transport(xmlrpc.client.Transport):
    """HTTP to a master that may hang: nothing takes longer than `_TIMEOUT`."""

    def make_connection(self, host):
        connection = super().make_connection(host)
        connection.timeout = _TIMEOUT
        return connection


class MasterWatch:
    """Looks at the master now and then, from a thread that nothing else waits for.

    Args:
        parameters: the node's private parameters, which a new master is given, too.
    """

    def __init__(self, parameters: Dict[str, Any], logger: logging.Logger) -> None:
        self._parameters = parameters
        self._logger = logger
        self._uri = rosgraph.get_master_uri()
        self._known: Optional[Tuple] = None     # the master that all is registered at

    def start(self) -> None:
        """Watch until the process ends."""
        threading.Thread(target=self._run, name='master watch', daemon=True).start()

    def _run(self) -> None:
        gone = False
        pause = threading.Event()
        while not rospy.is_shutdown():
            try:
                self._look()
                gone = False
            except Exception as error:  # pylint: disable=broad-except
                # Whatever a master that is ending, starting or no master at all may answer.
                if not gone and not rospy.core.is_shutdown_requested():
                    gone = True
                    self._logger.warning('no answer from the ROS master %s (%s); '
                                         'who is connected stays connected', self._uri, error)
            pause.wait(_PERIOD)

    def _look(self) -> None:
        """Register again if the master is another one, or has lost this node."""
        with xmlrpc.client.ServerProxy(self._uri, _Transport()) as master:
            name = rospy.get_name()
            ask = xmlrpc.client.MultiCall(master)
            ask.getPid(name)
            ask.getParam(name, '/run_id')       # a new one for each roscore; none of a bare master
            ask.lookupNode(name, name)
            (_, _, pid), (_, _, run_id), (found, _, uri) = ask()
            if found == 1 and uri != rospy.get_node_uri():
                raise ValueError(f'another node is named {name}')
            seen = (pid, run_id)
            if found == 1 and self._known in (None, seen):
                self._known = seen
            elif not rospy.core.is_shutdown_requested():
                self._register(master, name)
                self._known = seen
                self._logger.info('%s is a new ROS master: registered topics, services and '
                                  'parameters there', self._uri)

    def _register(self, master: xmlrpc.client.ServerProxy, name: str) -> None:
        """All that rospy knows of, in one request."""
        uri = rospy.get_node_uri()
        topics = registration.get_topic_manager()
        subscriptions = topics.get_subscriptions()
        tell = xmlrpc.client.MultiCall(master)
        for topic, type_ in subscriptions:
            tell.registerSubscriber(name, topic, type_, uri)
        for topic, type_ in topics.get_publications():
            tell.registerPublisher(name, topic, type_, uri)
        for service, service_uri in registration.get_service_manager().get_services():
            tell.registerService(name, service, service_uri, uri)
        if self._parameters:
            _, _, there = master.getParam(name, name)
            tell.setParam(name, name, _merged(self._parameters, there))
        answers = list(tell())
        for code, text, _ in answers:
            if code != 1:
                raise ValueError(text)
        for listener in registration.get_registration_listeners().listeners:
            if isinstance(listener, registration.RegManager):
                for (topic, _), (_, _, publishers) in zip(subscriptions, answers):
                    listener.publisher_update(topic, publishers)


def _merged(ours: Dict[str, Any], theirs: Any) -> Dict[str, Any]:
    """What somebody has set at the new master already stands; the rest is as at our start."""
    if not isinstance(theirs, dict):    # 0 where the master has nothing of that name
        return ours
    merged = dict(ours)
    for key, value in theirs.items():
        both = isinstance(value, dict) and isinstance(ours.get(key), dict)
        merged[key] = _merged(ours[key], value) if both else value
    return merged
