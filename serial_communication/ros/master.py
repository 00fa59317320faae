"""Questions to the ROS master and to nodes, in limited time: before this process is a node, and by
a node that watches for a new master."""
import os
import sys
import threading
import time
import xmlrpc.client
from contextlib import suppress
from typing import Any, Callable, Mapping, Optional

import rosgraph
import rospy

_ASK_EVERY = 0.1                           # s
_FIRST_REPORT, _REPORT_EVERY = 1.0, 10.0   # s of waiting
_PATIENCE = 1.0                            # s for an answer, by default
_WATCH_EVERY = 3.0                         # s


class _Transport(xmlrpc.client.Transport):
    """HTTP whose answers take a limited time."""

    def __init__(self, patience: float) -> None:
        super().__init__()
        self._patience = patience

    def make_connection(self, host: Any) -> Any:
        connection = super().make_connection(host)
        connection.timeout = self._patience
        return connection


def _ask(uri: str, question: str, *arguments: str, patience: float = _PATIENCE) -> Any:
    """Return the answer of a master or a node; None for a failure. It may raise anything."""
    server = xmlrpc.client.ServerProxy(uri, _Transport(patience))
    code, _text, value = getattr(server, question)(rospy.get_name(), *arguments)
    return value if code == 1 else None


def wait_for_master(stopping: Optional[threading.Event] = None,
                    say: Callable[[str], None] = lambda _text: None,
                    patience: float = float('inf')) -> bool:
    """Wait for a ROS master; return whether one answers.

    Args:
        stopping: ends the waiting when set.
        say: called with a line of text after 1 s, then every 10 s.
        patience: s to wait at most.
    """
    stopping = stopping or threading.Event()
    uri = rosgraph.get_master_uri()
    began = time.monotonic()
    due = began + _FIRST_REPORT
    while not stopping.is_set() and time.monotonic() < began + patience:
        try:
            _ask(uri, 'getPid')
            return True
        except Exception:  # pylint: disable=broad-except
            pass    # a master that is starting or ending, or another server, may answer anything
        if time.monotonic() >= due:
            say(f'waiting for the ROS master at {uri}; start one with roscore, or set '
                'ROS_MASTER_URI')
            due = time.monotonic() + _REPORT_EVERY
        stopping.wait(_ASK_EVERY)
    return False


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
    try:
        uri = _ask(rosgraph.get_master_uri(), 'lookupNode', name, patience=patience)
        return uri if uri and _ask(uri, 'getName', patience=patience) == name else ''
    except Exception:  # pylint: disable=broad-except
        return ''   # a process that is ending, or is not a node, may answer anything


class MasterWatch:
    """Asks the master every 3 s whether it is a new one, in a thread that nothing waits for.

    A new roscore knows neither the nodes that are running nor their parameters, and rospy does not
    notice. A master that is only gone changes nothing.

    Create it before rospy.init_node: a master that is replaced while the node starts is a new one,
    too.
    """

    def __init__(self) -> None:
        self._uri = rosgraph.get_master_uri()
        self._pid = None
        with suppress(Exception):
            self._pid = self._question('getPid')

    def start(self, on_new: Callable[[], None]) -> None:
        """Call `on_new` in the thread, once: the master does not know this node."""
        threading.Thread(target=self._run, args=(on_new,), name='master watch',
                         daemon=True).start()

    def _run(self, on_new: Callable[[], None]) -> None:
        while True:
            try:
                node = self._question('lookupNode', rospy.get_name())
                # A topic that was made since may be registered at the new master.
                is_new = not node or self._question('getPid') != self._pid
            except Exception:  # pylint: disable=broad-except
                pass    # it is gone, or another server answers there
            else:
                if rospy.core.is_shutdown_requested():
                    return
                if node and node != rospy.get_node_uri():
                    rospy.signal_shutdown(f'another node is named {rospy.get_name()}')
                    return
                if is_new:
                    rospy.logwarn('%s is a new ROS master: this node starts again there', self._uri)
                    on_new()
                    return
            time.sleep(_WATCH_EVERY)

    def _question(self, question: str, *arguments: str) -> Any:
        return _ask(self._uri, question, *arguments)


def restart(environment: Mapping[str, str]) -> None:
    """Start this program again in this process, with these variables besides its environment.

    It does not return. Nothing is restarted once the node's shutdown has begun.
    """
    if rospy.core.is_shutdown_requested():
        return
    try:
        with open('/proc/self/cmdline', 'rb') as file:
            arguments = file.read().split(b'\0')[:-1]
        os.execve(sys.executable, arguments, {**os.environ, **environment})
    except OSError as error:
        print(f'cannot start again: {error}', file=sys.stderr)
        os._exit(1)
