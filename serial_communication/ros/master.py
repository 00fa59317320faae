"""Questions to the ROS master before this process registers: is it running, is a name in use."""
import sys
import threading
import time
import xmlrpc.client
from typing import Any, Callable, List, Optional

import rosgraph

_ASK_EVERY = 0.1                           # s
_FIRST_REPORT, _REPORT_EVERY = 1.0, 10.0   # s of waiting
_PATIENCE = 1.0                            # s for a node's answer, by default


def wait_for_master(stopping: threading.Event, say: Callable[[str], None] = lambda _text: None,
                    patience: Optional[float] = None) -> bool:
    """Wait for a ROS master.

    Args:
        stopping: ends the waiting when set.
        say: called with a line of text after 1 s, then every 10 s.
        patience: s to wait at most; None: no limit.

    Returns:
        Whether a master answers; False if the waiting ended first.
    """
    found = threading.Event()
    ended = threading.Event()

    def ask() -> None:      # in a thread, since an unreachable host may take minutes to fail
        while not ended.is_set():
            if rosgraph.is_master_online():
                found.set()
                return
            ended.wait(_ASK_EVERY)

    threading.Thread(target=ask, name='waiting for a master', daemon=True).start()
    began = now = time.monotonic()
    due = began + _FIRST_REPORT
    while not found.wait(_ASK_EVERY) and not stopping.is_set() \
            and (patience is None or now < began + patience):
        now = time.monotonic()
        if now >= due:
            say(f'waiting for the ROS master at {rosgraph.get_master_uri()}; '
                'start one with roscore, or set ROS_MASTER_URI')
            due = now + _REPORT_EVERY
    ended.set()
    return found.is_set() and not stopping.is_set()


def full_name(default: str) -> str:
    """Return this process's full node name, from its command line and environment."""
    name = rosgraph.names.load_mappings(sys.argv).get('__name', default)
    return rosgraph.names.resolve_name(name, rosgraph.names.get_ros_namespace() + 'unnamed')


def started_by_roslaunch() -> bool:
    """Return whether roslaunch started this process; it names each node's log file."""
    return '__log' in rosgraph.names.load_mappings(sys.argv)


def running_node(name: str, patience: float = _PATIENCE) -> str:
    """Return the URI of the node with this full name, if it answers in time; otherwise ''.

    A killed or suspended node does not count, nor does another process at a dead node's address.
    """
    found: List[str] = []
    asking = threading.Thread(target=_ask, args=(name, found), name='is the name taken',
                              daemon=True)
    asking.start()          # an unreachable host may take minutes to fail
    asking.join(patience)
    return found[0] if found else ''


def _ask(name: str, found: List[str]) -> None:
    try:
        uri = rosgraph.Master(name).lookupNode(name)
        with xmlrpc.client.ServerProxy(uri) as node:
            if _is_running(node, name):
                found.append(uri)
    except Exception:  # pylint: disable=broad-except
        pass    # no such node; or a process that is ending, or is not a node, may answer anything


def _is_running(node: Any, name: str) -> bool:
    """Return whether the process at a node's address is a node, and has not another name."""
    if node.getPid(name)[0] != 1:
        return False
    try:
        return node.getName(name)[2] == name
    except xmlrpc.client.Fault:
        return True     # only rospy's nodes report their name
