"""Calls of the ROS master have a time limit, and the start of the node repeats those that fail.

rospy waits for the master when it registers a topic or a service. Its other calls, such as those
that read parameters, raise an error, so a master that ends while a node starts would end the node,
too. And no call has a time limit: one to a master that has vanished from the network never returns.
"""
import http.client
import threading
import time
import xmlrpc.client
from typing import Any, Callable, Dict, List

import rosgraph
import rospy

from .master_watch import merged
from .private_parts import Guard
from .shutdown import is_shutdown_requested

_GUARD = Guard('rospy.core:xmlrpcapi rospy.core:_LockedServerProxy', {'ffa0c7410e6c6cd9'},
               'calls the master',
               'a master that ends while the node starts may end the node')
_COMMAND_LINE = Guard('rospy.client:load_command_line_node_params', {'fe36385572c50e51'},
                      'reads its command line',
                      'a master that ends while the node starts may lose the parameters of the '
                      'command line')
TIME_LIMIT = 3.0        # s for each answer
_AGAIN = 0.2            # s until the next try
_FIRST_REPORT, _REPORT_EVERY = 1.0, 10.0    # s of waiting


class _Transport(xmlrpc.client.Transport):
    """HTTP with a time limit."""

    def make_connection(self, host: Any) -> http.client.HTTPConnection:
        connection = super().make_connection(host)
        connection.timeout = TIME_LIMIT
        return connection


def limit_time() -> None:
    """Limit the time of every XML-RPC call that this process makes from now on."""
    xmlrpc.client.Transport = _Transport    # type: ignore[misc]


def install(say: Callable[[str], None], warn: Callable[[str], None]) -> None:
    """Patch rospy, if its source is known; call this before rospy calls the master.

    Until the node is shut down, a call of the main thread is then repeated until it succeeds.

    Args:
        say: called with a line of text if that takes long.
        warn: called if the source is not known.
    """
    if not _GUARD.passes(warn):
        return
    locked_proxy = rospy.core._LockedServerProxy

    class PatientProxy(locked_proxy):   # type: ignore[misc, valid-type]  # it is not typed
        """A proxy that repeats calls. It waits without its lock, which other threads need."""

        def _ServerProxy__request(self, method: str, arguments: Any) -> Any:
            began = time.monotonic()
            due = began + _FIRST_REPORT
            while True:
                try:
                    return super()._ServerProxy__request(method, arguments)
                except xmlrpc.client.Fault:
                    raise       # it is an answer
                except Exception:  # pylint: disable=broad-except
                    # A master that is starting or ending, or another server, may answer anything.
                    if threading.current_thread() is not threading.main_thread():
                        raise
                if is_shutdown_requested():
                    raise rospy.ROSInterruptException('while the node waited for the ROS master')
                if time.monotonic() >= due:
                    say(f'waiting for the ROS master at {rosgraph.get_master_uri()}')
                    due = time.monotonic() + _REPORT_EVERY
                time.sleep(_AGAIN)

    rospy.core._LockedServerProxy = PatientProxy


def parameters_of(arguments: List[str], warn: Callable[[str], None]) -> Dict[str, Any]:
    """Return the tree of the parameters on a command line, such as ``_bus/port:=/dev/ttyS0``.

    rospy sets them once, perhaps at a master that has ended since.
    """
    tree: Dict[str, Any] = {}
    if not _COMMAND_LINE.passes(warn):
        return tree
    for path, value in rospy.client.load_command_line_node_params(arguments).items():
        for name in reversed(path.strip('/').split('/')):
            value = {name: value}
        tree = merged(tree, value)
    return tree
