"""Questions to the ROS master and to nodes, in limited time: before this process is a node, and by
a node that watches for a new master."""
import os
import sys
import threading
import time
import xmlrpc.client
from contextlib import suppress
from typing import Any, Callable, Mapping

import rosgraph
import rospy

_PATIENCE = 1.0        # s for an answer
_WATCH_EVERY = 3.0     # s


class _Transport(xmlrpc.client.Transport):
    """HTTP whose answers take a limited time."""

    def make_connection(self, host: Any) -> Any:
        connection = super().make_connection(host)
        connection.timeout = _PATIENCE
        return connection


def ask(uri: str, question: str, *arguments: str) -> Any:
    """Return the answer of a master or a node; None for a failure. A server that is starting or
    ending, or is another program, may raise anything."""
    server = xmlrpc.client.ServerProxy(uri, _Transport())
    code, _text, value = getattr(server, question)(rospy.get_name(), *arguments)
    return value if code == 1 else None


def full_name(default: str) -> str:
    """Return this process's full node name, from its command line and environment."""
    name = rosgraph.names.load_mappings(sys.argv).get('__name', default)
    return rosgraph.names.resolve_name(name, rosgraph.names.get_ros_namespace() + 'unnamed')


def started_by_roslaunch() -> bool:
    """Return whether roslaunch started this process; it names each node's log file."""
    return '__log' in rosgraph.names.load_mappings(sys.argv)


def running_node(name: str) -> str:
    """Return the URI of the node with this full name, if it answers; otherwise ''.

    A killed or suspended node does not count, nor does another process at a dead node's address.
    """
    with suppress(Exception):
        uri = ask(rosgraph.get_master_uri(), 'lookupNode', name)
        if uri and ask(uri, 'getName') == name:
            return uri
    return ''


def watch_master(on_new: Callable[[], None]) -> None:
    """Ask the master every 3 s, in a thread, whether it knows this node; call `on_new` there if it
    does not.

    A new roscore knows neither the nodes that are running nor their parameters, and rospy does not
    notice. A master that is only gone changes nothing.
    """
    threading.Thread(target=_watch, args=(on_new,), name='master watch', daemon=True).start()


def _watch(on_new: Callable[[], None]) -> None:
    uri, first = rosgraph.get_master_uri(), None
    while True:
        with suppress(Exception):
            pid, node = ask(uri, 'getPid'), ask(uri, 'lookupNode', rospy.get_name())
            first = first or pid
            if not node or pid != first:    # a topic made since may be registered at a new one
                break
        time.sleep(_WATCH_EVERY)
    if not rospy.core.is_shutdown_requested():
        rospy.logwarn('%s is a new ROS master: this node starts again there', uri)
        on_new()


def restart(environment: Mapping[str, str]) -> None:
    """Start this program again in this process, with these variables besides its environment,
    unless the node's shutdown has begun."""
    if rospy.core.is_shutdown_requested():
        return
    try:
        os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, **environment})
    except OSError as error:
        print(f'cannot start again: {error}', file=sys.stderr)
        os._exit(1)
