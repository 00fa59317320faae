"""What is asked of the ROS master by a process that has not registered anything there yet:
whether it is there, and whether a name is taken."""
import sys
import threading
import time
import xmlrpc.client
from typing import Callable, List, Optional

import rosgraph

_ASK_EVERY = 0.1                       # s
_FIRST_WORD, _NEXT_WORD = 1.0, 10.0    # s until a person is told that one is waited for
_PATIENCE = 1.0                        # s for a node's answer


def wait_for_master(stopping: threading.Event, say: Callable[[str], None] = lambda _text: None,
                    patience: Optional[float] = None) -> bool:
    """Wait for a ROS master; False if `stopping` was set, or `patience` (s) ended, before.

    Args:
        say: is told every 10 s that a master is waited for.
    """
    found = threading.Event()
    ended = threading.Event()

    def ask() -> None:      # in a thread, since a host that does not answer may take minutes
        while not ended.is_set():
            if rosgraph.is_master_online():
                found.set()
                return
            ended.wait(_ASK_EVERY)

    threading.Thread(target=ask, name='waiting for a master', daemon=True).start()
    began = now = time.monotonic()
    due = began + _FIRST_WORD
    while not found.wait(_ASK_EVERY) and not stopping.is_set() \
            and (patience is None or now < began + patience):
        now = time.monotonic()
        if now >= due:
            say(f'waiting for the ROS master at {rosgraph.get_master_uri()}; '
                'start one with roscore, or set ROS_MASTER_URI')
            due = now + _NEXT_WORD
    ended.set()
    return found.is_set() and not stopping.is_set()


def full_name(default: str) -> str:
    """The name that this process has as a node, by its command line and its environment."""
    name = rosgraph.names.load_mappings(sys.argv).get('__name', default)
    return rosgraph.names.resolve_name(name, rosgraph.names.get_ros_namespace() + 'unnamed')


def by_roslaunch() -> bool:
    """Whether roslaunch has started this process: it gives each one a log file by name."""
    return '__log' in rosgraph.names.load_mappings(sys.argv)


def living_node(name: str) -> str:
    """The URI of a node of this full name that answers within 1 s; '' where there is none.

    A process that has another node's old address is none of it, and one that has been killed or
    stands still is no hindrance to who starts in its place.
    """
    found: List[str] = []
    asking = threading.Thread(target=_ask, args=(name, found), name='is the name taken',
                              daemon=True)
    asking.start()          # a host that is not there answers after minutes
    asking.join(_PATIENCE)
    return found[0] if found else ''


def _ask(name: str, found: List[str]) -> None:
    try:
        uri = rosgraph.Master(name).lookupNode(name)
        with xmlrpc.client.ServerProxy(uri) as node:
            if node.getPid(name)[0] == 1 and _name_of(node, name) == name:
                found.append(uri)
    except Exception:  # pylint: disable=broad-except
        pass    # no such node, or whatever a process that is ending, or no node, may answer


def _name_of(node: xmlrpc.client.ServerProxy, default: str) -> str:
    """What a node calls itself, if it is one of those that can tell (rospy's)."""
    try:
        return node.getName(default)[2]
    except xmlrpc.client.Fault:
        return default
