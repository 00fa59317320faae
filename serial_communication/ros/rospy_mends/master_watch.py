"""Registers the node again after roscore was restarted; rospy registers it at the start only.

A new roscore does not know the nodes that are running. Connected peers stay connected, but nobody
can find the node's topics, services and parameters.
"""
import logging
import threading
import xmlrpc.client
from typing import Any, Dict, Optional, Tuple

import rosgraph
import rospy
from rospy.impl import registration

from .private_parts import Guard
from .shutdown import is_shutdown_requested

_GUARD = Guard('rospy.topics:_TopicManager.get_subscriptions '
               'rospy.topics:_TopicManager.get_publications '
               'rospy.service:ServiceManager.get_services '
               'rospy.impl.registration:RegistrationListeners.add_listener '
               'rospy.impl.registration:RegManager.publisher_update', {'0e903c5e99440f24'},
               'registers',
               'after a restart of roscore the node has to be started again')
_PERIOD = 3.0     # s between checks of the master


class MasterWatch:
    """Checks every 3 s for a new master, in a thread that nothing else waits for.

    Create it before the node registers anything: a master that is replaced while the node starts
    is a new one, too.

    Args:
        name: the node's full name.
    """

    def __init__(self, name: str, logger: logging.Logger) -> None:
        self._name = name
        self._parameters: Dict[str, Any] = {}
        self._logger = logger
        self._uri = rosgraph.get_master_uri()
        # pid and run_id of the master that knows the node; None: not known
        self._known: Optional[Tuple[int, str]] = None
        try:
            with xmlrpc.client.ServerProxy(self._uri) as master:
                self._known, _, _ = self._ask(master)
        except Exception:  # pylint: disable=broad-except
            pass        # see _run

    def start(self, parameters: Dict[str, Any]) -> None:
        """Watch until the process ends, if the source of rospy is known.

        Args:
            parameters: the node's private parameters, which are set at a new master, too.
        """
        self._parameters = parameters
        if _GUARD.passes(self._logger.warning):
            threading.Thread(target=self._run, name='master watch', daemon=True).start()

    def _run(self) -> None:
        gone = False
        pause = threading.Event()
        while not rospy.is_shutdown():
            try:
                self._check()
                gone = False
            except Exception as error:  # pylint: disable=broad-except
                # A master that is starting or ending, or another server, may answer anything.
                if not gone and not is_shutdown_requested():
                    gone = True
                    self._logger.warning('no answer from the ROS master %s (%s); connected nodes '
                                         'stay connected; start roscore again', self._uri, error)
            pause.wait(_PERIOD)

    def _ask(self, master: Any) -> Tuple[Tuple[int, str], bool, str]:
        """Return the master's pid and run_id, whether it knows the node, and the node's address."""
        ask: Any = xmlrpc.client.MultiCall(master)
        ask.getPid(self._name)
        ask.getParam(self._name, '/run_id')     # each roscore has a new one; rosmaster has none
        ask.lookupNode(self._name, self._name)
        (_, _, pid), (has_id, _, run_id), (found, _, uri) = ask()
        return (pid, run_id if has_id == 1 else ''), found == 1, uri

    def _check(self) -> None:
        """Register again if the master is a new one, or does not know this node."""
        with xmlrpc.client.ServerProxy(self._uri) as master:
            seen, found, uri = self._ask(master)
            if found and uri != rospy.get_node_uri():
                raise ValueError(f'another node is named {self._name}')
            # A roscore that has just started sets its run_id a little later.
            if found and self._known in (seen, (seen[0], '')):
                self._known = seen
            elif not is_shutdown_requested():
                self._register(master, self._name)
                self._known = seen
                self._logger.info('%s is a new ROS master: registered topics, services and '
                                  'parameters there', self._uri)

    def _register(self, master: Any, name: str) -> None:
        """Register all topics and services, and set the parameters, in one request."""
        uri = rospy.get_node_uri()
        topics = registration.get_topic_manager()
        subscriptions = topics.get_subscriptions()
        calls: Any = xmlrpc.client.MultiCall(master)
        for topic, type_ in subscriptions:
            calls.registerSubscriber(name, topic, type_, uri)
        for topic, type_ in topics.get_publications():
            calls.registerPublisher(name, topic, type_, uri)
        for service, service_uri in registration.get_service_manager().get_services():
            calls.registerService(name, service, service_uri, uri)
        if self._parameters:
            _, _, there = master.getParam(name, name)
            calls.setParam(name, name, merged(self._parameters, there))
        answers = list(calls())
        for code, text, _ in answers:
            if code != 1:
                raise ValueError(text)
        for listener in registration.get_registration_listeners().listeners:
            if isinstance(listener, registration.RegManager):
                for (topic, _), (_, _, publishers) in zip(subscriptions, answers):
                    listener.publisher_update(topic, publishers)


def merged(ours: Dict[str, Any], theirs: Any) -> Dict[str, Any]:
    """Return our parameters; a value that the new master already has takes precedence."""
    if not isinstance(theirs, dict):    # the master answers 0 if it has none
        return ours
    result = dict(ours)
    for key, value in theirs.items():
        both = isinstance(value, dict) and isinstance(ours.get(key), dict)
        result[key] = merged(ours[key], value) if both else value
    return result
