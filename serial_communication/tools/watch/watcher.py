"""Watches one bridge through its master and its topics, and sends it nothing.

Every message is counted, but only the latest of each topic is deserialized, in `update`. The
master is asked which topics the bridge has, so that custom messages and boards of other packages
appear by themselves.
"""
import threading
import time
from contextlib import suppress
from typing import Any, Callable, Dict, Iterable, Optional

import roslib.message
import rosgraph
import rospy
from diagnostic_msgs.msg import DiagnosticArray

from ...ros.master import ask
from .state import BridgeState, LinkState
from .topics import DIAGNOSTICS, BridgeTopic, absolute, expected_links, published_topics

_ASK_EVERY = 1.0      # s between two requests to the master
_TRY_EVERY = 0.1      # s, while none answers
_FIRST_REPORT, _REPORT_EVERY = 3.0, 10.0   # s of waiting for one
_BUFFER = 1 << 18     # bytes; with rospy's 64 KiB the latest message waits behind older ones


def wait_for_master(stopping: threading.Event, say: Callable[[str], object],
                    patience: float = float('inf')) -> bool:
    """Wait for a ROS master, for `patience` s at most; return whether one answers.

    Args:
        stopping: ends the waiting when set.
        say: called with a line of text after 3 s, then every 10 s.
    """
    uri, began = rosgraph.get_master_uri(), time.monotonic()
    due = began + _FIRST_REPORT
    while not stopping.is_set() and time.monotonic() < began + patience:
        with suppress(Exception):
            ask(uri, 'getPid')
            return True
        if time.monotonic() >= due:
            say(f'waiting for the ROS master at {uri}; start one with roscore, or set '
                'ROS_MASTER_URI')
            due = time.monotonic() + _REPORT_EVERY
        stopping.wait(_TRY_EVERY)
    return False


def unpack(topic: BridgeTopic, data: bytes) -> Any:
    """Deserialize a message of a topic; ValueError if its type is not installed here, and whatever
    genpy raises if it is of another type."""
    found = roslib.message.get_message_class(topic.type)
    if found is None:
        raise ValueError(f'the type {topic.type} is not installed here')
    return found().deserialize(data)


class Watcher:
    """Keeps a `BridgeState` up to date, in a process that has called rospy.init_node.

    Only messages from that node count: other nodes publish on /tf and /diagnostics too, and other
    bridges in the same namespace on serial_msg.

    Args:
        state: is kept up to date.
        wants: whether to subscribe to a topic; /diagnostics is always subscribed to.
        on_message: is called in rospy's threads for every message, with its topic, the serialized
            message (see `unpack`) and the time it was received.
    """

    def __init__(self, state: BridgeState,
                 wants: Callable[[BridgeTopic], bool] = lambda _topic: True,
                 on_message: Optional[Callable[[BridgeTopic, bytes, float], None]] = None) -> None:
        self._state = state
        self._wants = wants
        self._on_message = on_message
        self._lock = threading.Lock()      # for the subscriptions
        self._subscribers: Dict[str, rospy.Subscriber] = {}     # by full name
        self._latest: Dict[str, bytes] = {}                     # by relative name
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name='master watch', daemon=True)

    def start(self) -> None:
        """Subscribe, and start to ask the master once a second."""
        self.subscribe()
        self._thread.start()

    def stop(self) -> None:
        """Unsubscribe from everything. Cannot be started again."""
        self._stopping.set()
        with self._lock:
            self._unsubscribe(list(self._subscribers))

    def update(self, now: float) -> None:
        """Update the rate of each topic, and the text of its latest message."""
        for each in self._state.topics:
            each.measure(now)
            latest = self._latest.pop(each.topic.name, None)
            if latest is None:
                continue
            try:
                each.words = each.topic.words(unpack(each.topic, latest))
            except Exception as error:  # pylint: disable=broad-except
                # The message may be of another version of the type.
                each.words = f'not as expected: {error}'

    # -- messages --------------------------------------------------------------------------

    def _receive(self, message: Any, name: str) -> None:
        if message._connection_header.get('callerid') != self._state.node:
            return
        each = self._state.topic(name)
        if each is not None:
            now = time.monotonic()
            self._latest[name] = message._buff
            each.received(now)
            if self._on_message:
                self._on_message(each.topic, message._buff, now)
        if name == DIAGNOSTICS:                # each message is about one link
            self._receive_links(DiagnosticArray().deserialize(message._buff))

    def _receive_links(self, message: Any) -> None:
        now = time.monotonic()
        for status in message.status:
            name = status.name.partition(': ')[2]
            # A status without values is the updater's notice that the node starts.
            if name.endswith(' link') and status.values:
                level = status.level       # some versions of genpy have bytes here
                self._state.set_link(name[:-len(' link')], LinkState(
                    ord(level) if isinstance(level, bytes) else level, status.message,
                    {pair.key: pair.value for pair in status.values}, now))

    # -- subscriptions ---------------------------------------------------------------------

    def subscribe(self) -> None:
        """Subscribe to the topics that are wanted now, and unsubscribe from the others."""
        wanted = {absolute(each.topic.name, self._state.node): each.topic.name
                  for each in self._state.topics if self._wants(each.topic)}
        wanted[DIAGNOSTICS] = DIAGNOSTICS
        with self._lock:
            if self._stopping.is_set():
                return
            self._unsubscribe(set(self._subscribers) - set(wanted))
            for name in set(wanted) - set(self._subscribers):
                self._subscribers[name] = rospy.Subscriber(
                    name, rospy.AnyMsg, self._receive, wanted[name], tcp_nodelay=True,
                    buff_size=_BUFFER)

    def _unsubscribe(self, names: Iterable[str]) -> None:
        for name in names:
            self._subscribers.pop(name).unregister()

    # -- the master ------------------------------------------------------------------------

    def _run(self) -> None:
        master = rosgraph.Master(rospy.get_name())
        while not self._stopping.is_set():
            try:
                self._ask(master)
            except (OSError, rosgraph.MasterException):
                pass    # BridgeState.trouble reports it, by the time of the last answer
            except Exception as error:  # pylint: disable=broad-except
                rospy.logwarn_throttle(10, f'asking the master: {error!r}')
            self._stopping.wait(_ASK_EVERY)

    def _ask(self, master: Any) -> None:
        state = self._state
        publishers, subscribers, services = master.getSystemState()
        published = {name for name, nodes in publishers if state.node in nodes}
        registered = bool(published) or any(state.node in nodes for _name, nodes in services)
        if registered:
            types = dict(master.getTopicTypes())
            given = master.getParam(state.node) if master.hasParam(state.node) else {}
            state.set_parameters(given if isinstance(given, dict) else {})
            state.expect_links(expected_links(state.parameters))
            state.set_topics(published_topics(
                state.node, {name: types.get(name, '*') for name in published},
                state.parameters, state.boards))
            # A restarted master knows neither this node nor, at first, the bridge. Messages still
            # arrive over the old connections, which are kept until the bridge has registered.
            ours = {name for name, nodes in subscribers if rospy.get_name() in nodes}
            with self._lock:
                self._unsubscribe(set(self._subscribers) & published - ours)
            self.subscribe()
        state.master_answered(registered, time.monotonic())
