"""A node's process: its arguments, its name, its master, and its end."""
import argparse
import os
import re
import sys
import threading
import time
import xmlrpc.client
from contextlib import suppress
from pathlib import Path
from typing import Any, Callable, List, Mapping

import rosgraph
import rospy

NAME_TAKEN = 3         # exit status if a node of the same name is running
_PATIENCE = 1.0        # s for an answer
_WATCH_EVERY = 3.0     # s
_ARGUMENT = re.compile(r'[\w~/]+:=')    # ROS: a remapping, a parameter, or a special key (__name)
_DESCRIPTION = f"""\
The node that connects the serial links of a robot to ROS, usually started by bridge.launch. It
takes ROS's arguments only; config/bridge.yaml documents its parameters.

Exit status 0: it was stopped; 1: a parameter is wrong, or something failed (see the log);
2: wrong arguments; {NAME_TAKEN}: a node of its name is already running.
"""


def check_arguments(arguments: List[str]) -> None:
    """Print the usage and exit if it was asked for, or if an argument is not one of ROS's."""
    argparse.ArgumentParser(
        'serial_communication_node', description=_DESCRIPTION,
        usage='%(prog)s [__name:=NAME] [__ns:=NAMESPACE] [_PARAMETER:=VALUE …] [OLD:=NEW …]',
        formatter_class=argparse.RawDescriptionHelpFormatter).parse_args(
            [each for each in arguments if not _ARGUMENT.match(each)])


def empty_ports() -> List[str]:
    """Return the name of each link that an argument such as ``mcu_port:=`` turned off.

    roslaunch drops an argument without a value, so its launch file cannot see it. Here it is read
    from the command line of the roslaunch above this process, if that started bridge.launch.
    """
    with suppress(OSError, ValueError):
        words = Path(f'/proc/{os.getppid()}/cmdline').read_text().split('\0')
        if any(os.path.basename(word) == 'bridge.launch' for word in words):
            return [word[:-len('_port:=')] for word in words if word.endswith('_port:=')]
    return []


class _Transport(xmlrpc.client.Transport):
    """HTTP whose answers take a limited time."""

    def make_connection(self, host: Any) -> Any:
        connection = super().make_connection(host)
        connection.timeout = _PATIENCE
        return connection


def ask(uri: str, question: str, *arguments: str) -> Any:
    """Return the answer of a master or a node, None for a failure; another server may raise
    anything."""
    server = xmlrpc.client.ServerProxy(uri, _Transport())
    code, _text, value = getattr(server, question)(rospy.get_name(), *arguments)
    return value if code == 1 else None


def full_name(default: str) -> str:
    """Return this process's full node name, from its command line and environment."""
    name = rosgraph.names.load_mappings(sys.argv).get('__name', default)
    return rosgraph.names.resolve_name(name, rosgraph.names.get_ros_namespace() + 'unnamed')


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
    def watch() -> None:
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

    threading.Thread(target=watch, name='master watch', daemon=True).start()


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


def end_within(seconds: float, status: int) -> None:
    """End the process so many seconds later, whatever hangs; the first call counts."""
    timer = threading.Timer(seconds, os._exit, [status])
    timer.daemon = True
    timer.start()
