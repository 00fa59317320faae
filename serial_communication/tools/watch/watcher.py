"""Looks at one bridge through its master and its topics, and never says anything to it.

Topics are counted as they come, but only the latest message of each is unpacked, when somebody
looks (`update`). Which topics a bridge has is asked of the master, so that custom messages and
boards of other packages appear by themselves.
"""
import atexit
import threading
import time
from typing import Any, Callable, Dict, Iterable, Optional

import roslib.message
import rosgraph
import rospy

from .state import BridgeState, LinkState
from .topics import DIAGNOSTICS, Topic, expected_links, known, resolve

_ASK_EVERY = 1.0      # s from one question to the master to the next
_FAREWELL = 2.0       # s
_BUFFER = 1 << 18     # bytes; rospy's 64 KiB would delay the latest message behind older ones


def leave(patience: float = _FAREWELL) -> None:
    """End this process's part in ROS; in `patience` s even where the master does not answer."""
    ending = threading.Thread(target=rospy.signal_shutdown, args=('it ends',), daemon=True)
    ending.start()
    ending.join(patience)
    if ending.is_alive():
        atexit.unregister(rospy.core._ros_atexit)    # which would wait for it


class Watcher:
    """Keeps a `BridgeState` up to date, in a process that has called rospy.init_node.

    Only messages that come from the node itself count: other nodes publish on /tf, /diagnostics
    and, with several bridges in one namespace, on serial_msg too.

    Args:
        state: what to fill.
        wants: which topics to subscribe to; /diagnostics always is one.
        on_message: is told of every message, in rospy's threads: its topic, what of `unpack` is
            to make a message, and when it came.
    """

    def __init__(self, state: BridgeState, wants: Callable[[Topic], bool] = lambda _topic: True,
                 on_message: Optional[Callable[[Topic, bytes, float], None]] = None) -> None:
        self._state = state
        self._wants = wants
        self._on_message = on_message
        self._lock = threading.Lock()      # of the subscriptions
        self._subscribers: Dict[str, rospy.Subscriber] = {}     # by full name
        self._latest: Dict[str, bytes] = {}                     # by relative name
        self._classes: Dict[str, Any] = {}                      # by type
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name='master watch', daemon=True)

    def start(self) -> None:
        """Subscribe, and ask the master from now on."""
        self.subscribe()
        self._thread.start()

    def stop(self) -> None:
        """Unsubscribe from everything, for good."""
        self._stopping.set()
        with self._lock:
            self._unsubscribe(list(self._subscribers))

    def update(self, now: float) -> None:
        """Rates, and the latest message of each topic in numbers and words."""
        for each in self._state.topics:
            each.measure(now)
            packed = self._latest.pop(each.topic.name, None)
            if packed is None:
                continue
            try:
                each.message = self.unpack(each.topic, packed)
                each.words = each.topic.words(each.message)
            except Exception as error:  # pylint: disable=broad-except
                # Whatever another version of the type may make of it.
                each.message, each.words = None, f'not as expected: {error}'

    def unpack(self, topic: Topic, packed: bytes) -> Any:
        """The message; an exception where it is none of the topic's type."""
        return self._class(topic.type)().deserialize(packed)

    # -- messages --------------------------------------------------------------------------

    def _take(self, message: Any, name: str) -> None:
        header = message._connection_header    # AnyMsg has no other way to tell who sent it
        if header.get('callerid') != self._state.node:
            return
        each = self._state.topic(name)
        if each is not None:
            now = time.monotonic()
            self._latest[name] = message._buff
            each.take(now)
            if self._on_message:
                self._on_message(each.topic, message._buff, now)
        if name == DIAGNOSTICS:                # each message is about one link
            self._take_links(self._class(header['type'])().deserialize(message._buff))

    def _take_links(self, message: Any) -> None:
        now = time.monotonic()
        for status in message.status:
            name = status.name.partition(': ')[2]
            # One without values is the updater's own word, that the node starts.
            if name.endswith(' link') and status.values:
                level = status.level       # some versions of genpy have bytes here
                self._state.take_link(name[:-len(' link')], LinkState(
                    ord(level) if isinstance(level, bytes) else level, status.message,
                    {pair.key: pair.value for pair in status.values}, now))

    def _class(self, type_: str) -> Any:
        if type_ not in self._classes:
            found = roslib.message.get_message_class(type_)
            if found is None:
                raise ValueError(f'the type {type_} is not installed here')
            self._classes[type_] = found
        return self._classes[type_]

    # -- subscriptions ---------------------------------------------------------------------

    def subscribe(self) -> None:
        """Subscribe to what is wanted now, and to nothing else."""
        wanted = {resolve(each.topic.name, self._state.node): each.topic.name
                  for each in self._state.topics if self._wants(each.topic)}
        wanted[DIAGNOSTICS] = DIAGNOSTICS
        with self._lock:
            if self._stopping.is_set():
                return
            self._unsubscribe(set(self._subscribers) - set(wanted))
            for name in set(wanted) - set(self._subscribers):
                self._subscribers[name] = rospy.Subscriber(
                    name, rospy.AnyMsg, self._take, wanted[name], tcp_nodelay=True,
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
                pass    # BridgeState.trouble tells, by the time of the last answer
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
            state.learn(self._parameters(master))
            state.expect_links(expected_links(state.parameters))
            state.set_topics(known(state.node, {name: types.get(name, '*') for name in published},
                                   state.parameters, state.boards))
            # A master that was started again knows neither us nor, at first, the bridge. What
            # still comes over the old connections is kept until the bridge is there again.
            ours = {name for name, nodes in subscribers if rospy.get_name() in nodes}
            with self._lock:
                self._unsubscribe(set(self._subscribers) & published - ours)
            self.subscribe()
        state.master_says(registered, time.monotonic())

    def _parameters(self, master: Any) -> Dict[str, Any]:
        try:
            given: Optional[Any] = master.getParam(self._state.node)
        except rosgraph.MasterError:
            given = None    # none are set
        return given if isinstance(given, dict) else {}
