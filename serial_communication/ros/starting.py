"""What the node does before it registers or opens anything.

It checks its command line, waits for a master, and ends if a node of its name is running.
"""
import errno
import os
import random
import re
import signal
import socket
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import List, Optional

import rosgraph
import rospy

from .master import full_name, running_node, started_by_roslaunch, wait_for_master
from .rospy_mends.shutdown import is_shutdown_requested, on_shutdown

NAME_TAKEN = 3            # exit status if a node of the same name is running
WRONG_ARGUMENTS = 2       # exit status
_AGAIN = 10.0             # s before it ends, since roslaunch starts it again at once
_LOCK_EVERY, _LOCK_PATIENCE = 0.05, 10.0    # s between tries; s until it goes on without the lock
_LONGEST_ADDRESS = 108    # bytes of a Unix socket's address
_DISPLACEMENTS = 'SERIAL_COMMUNICATION_DISPLACEMENTS'    # environment of the next start
_MOST_DISPLACEMENTS = 5   # in a row; after them the other node must be running, but unreachable
_LONG_LIFE = 60.0         # s of running after which displacements are counted from 0 again
_REASON = 0.4             # s to wait for the reason of a shutdown
_STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_PROGRAM = 'serial_communication_node'
_ARGUMENT = re.compile(r'[\w~/]+:=')    # ROS: a remapping, a parameter, or a special key (__name)
_USAGE = f"""\
usage: {_PROGRAM} [__name:=NAME] [__ns:=NAMESPACE] [_PARAMETER:=VALUE …] [OLD:=NEW …]

The node that connects the serial links of a robot to ROS. It takes ROS's arguments only;
config/bridge.yaml documents its parameters. Some ways to start it:
  roslaunch serial_communication bridge.launch --ros-args     list the launch file's arguments
  roslaunch serial_communication bridge.launch sim:=true      with simulated boards
  rosrun serial_communication {_PROGRAM} _bus/port:=/dev/ttyS0

Exit status 0: it was stopped; 1: a parameter is wrong, or something failed (see the log);
{WRONG_ARGUMENTS}: wrong arguments; {NAME_TAKEN}: a node of its name is already running.
With a wrong parameter, a node that roslaunch started does not exit, since roslaunch would start
it again: it waits until it is stopped.
"""


def check_arguments(arguments: List[str]) -> None:
    """Print the usage and exit if it was asked for, or if an argument is not one of ROS's."""
    if '-h' in arguments or '--help' in arguments:
        print(_USAGE, end='')
        sys.exit(0)
    for argument in arguments:
        if not _ARGUMENT.match(argument):
            print(f'{_PROGRAM}: unknown argument {argument!r}\n{_USAGE}', end='',
                  file=sys.stderr)
            sys.exit(WRONG_ARGUMENTS)


class Start:
    """One start of the node; makes sure that only one node of its name runs.

    If two nodes of one name start at the same time, exactly one must keep running. On one host a
    lock makes the second wait until the first is registered. On two hosts both may find the name
    free, and the master then ends one or both of them ("displaced"). A displaced node waits a
    random time, starts again, and checks the name again.
    """

    def __init__(self, default_name: str) -> None:
        self.stopping = threading.Event()       # set by SIGINT, SIGTERM and SIGHUP
        self._name = full_name(default_name)
        self._lock = _NameLock(self._name)
        self._began = time.monotonic()
        self._displaced = False
        self._reason_known = threading.Event()

    def wait_until_allowed(self) -> Optional[int]:
        """Wait for a master, then check that the node's name is free there.

        SIGINT and SIGTERM end the waiting; rospy.init_node later replaces their handlers, and
        calls these, too.

        Returns:
            None: call rospy.init_node, then `registered`. Otherwise the exit status to end with.
        """
        for number in _STOP_SIGNALS:
            signal.signal(number, lambda *_: self.stopping.set())
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _STOP_SIGNALS)
        if not wait_for_master(self.stopping, say):
            return 0
        on_shutdown(self._on_shutdown)
        status = self._after_displacements() or self._wait_for_name()
        return 0 if self.stopping.is_set() else status

    def registered(self) -> None:
        """Release the lock; call this once rospy.init_node has registered the node."""
        self._lock.release()

    def restart_if_displaced(self) -> None:
        """If another node took the name, start again in this process, and do not return."""
        if is_shutdown_requested():
            self._reason_known.wait(_REASON)
        if not self._displaced:
            return
        before = _displacements() if time.monotonic() - self._began < _LONG_LIFE else 0
        # Signals stay blocked until the new process has handlers, in `wait_until_allowed`. A signal
        # that another thread gets before then would be lost, so it ends the process.
        signal.pthread_sigmask(signal.SIG_BLOCK, _STOP_SIGNALS)
        with suppress(ValueError):      # only the main thread may set handlers
            for number in _STOP_SIGNALS:
                signal.signal(number, signal.SIG_DFL)
        if self.stopping.is_set():
            return
        try:
            # One interpreter cannot initialise rospy twice.
            os.execve(sys.executable, [sys.executable, *sys.argv],
                      {**os.environ, _DISPLACEMENTS: str(before + 1)})
        except OSError:
            os._exit(NAME_TAKEN)

    def force_exit(self, status: int) -> None:
        """End the process at once, even if something hangs."""
        self.restart_if_displaced()
        os._exit(status)

    def _on_shutdown(self, reason: str) -> None:
        self._displaced = 'new node registered with same name' in reason
        self._reason_known.set()
        if self._displaced:
            rospy.logwarn(f'another node has registered as {self._name}: this one ends, and checks '
                          'in a few seconds whether that one is running')

    def _after_displacements(self) -> Optional[int]:
        """Wait a random time if this node was displaced; return an exit status to end, or None."""
        number = _displacements()
        if number > _MOST_DISPLACEMENTS:
            say(f'another node has registered as {self._name} {number} times, but does not answer '
                'this host; is it reachable from here (ROS_IP, ROS_HOSTNAME)? Otherwise give one '
                'of the two another name')
            return NAME_TAKEN
        if number:
            self.stopping.wait(random.uniform(0.5, 4.0 * number))
        return None

    def _wait_for_name(self) -> Optional[int]:
        """Take the lock if no node of this name is running; otherwise return the exit status.

        At a terminal the node ends at once. Under roslaunch, which would start it again at once,
        it waits 10 s, and goes on if the other node ends meanwhile.
        """
        deadline = None
        while not self.stopping.is_set():
            self._lock.acquire(self.stopping)
            address = running_node(self._name)
            if not address:
                return None
            self._lock.release()
            if deadline is None:
                deadline = time.monotonic() + _AGAIN
                say(f'{self._name} is already running ({address}); end that node first (rosnode '
                    f'kill {self._name}), or give this one another name (name:=NAME for the '
                    'launch file, __name:=NAME for the node)')
            if not started_by_roslaunch() or time.monotonic() >= deadline:
                return NAME_TAKEN
            self.stopping.wait(1.0)
        return 0


class _NameLock:
    """A lock on this host, held from the check of the name until the node is registered.

    It is an abstract Unix socket: the kernel releases it however its process ends, it leaves no
    file, and it works across users.
    """

    def __init__(self, name: str) -> None:
        # The address has no host, since a host may have several names. With two masters on the
        # same port, a start may therefore wait for an unrelated one.
        _, port = rosgraph.network.parse_http_host_and_port(rosgraph.get_master_uri())
        self._name = name
        self._address = f'\0{_PROGRAM} {port} {name}'.encode()[:_LONGEST_ADDRESS]
        self._socket: Optional[socket.socket] = None

    def acquire(self, stopping: threading.Event) -> None:
        """Wait for the lock, 10 s at most, since its holder may hang."""
        began, reported = time.monotonic(), False
        while not self._bind() and not stopping.wait(_LOCK_EVERY):
            waited = time.monotonic() - began
            if waited > _LOCK_PATIENCE:
                return
            if waited > 1.0 and not reported:
                reported = True
                say(f'another {self._name} is starting on this host; waiting for it')

    def release(self) -> None:
        """Release the lock, if it is held."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _bind(self) -> bool:
        """Return whether to stop trying: the lock is held, or this system does not offer it."""
        try:
            holder = socket.socket(socket.AF_UNIX)
        except OSError:
            return True
        try:
            holder.bind(self._address)
        except OSError as error:
            holder.close()
            return error.errno != errno.EADDRINUSE
        self._socket = holder
        return True


def _displacements() -> int:
    """Return how often in a row this process was displaced."""
    return int(os.environ.get(_DISPLACEMENTS, '0'))


def empty_ports() -> List[str]:
    """Return the name of each link that an argument such as ``mcu_port:=`` turned off.

    roslaunch drops an argument without a value, so its launch file cannot see it. Here it is read
    from the command line of the roslaunch above this process, if that started bridge.launch.
    """
    try:
        words = Path(f'/proc/{os.getppid()}/cmdline').read_text().split('\0')
    except (OSError, ValueError):
        return []
    if not any(os.path.basename(word) == 'bridge.launch' for word in words):
        return []
    return [word[:-len('_port:=')] for word in words if word.endswith('_port:=')]


def wait_under_roslaunch() -> None:
    """Under roslaunch, wait until the node is stopped; otherwise return at once.

    Call this after logging a permanent error such as a wrong parameter. roslaunch would otherwise
    start the node again, with the same parameters and the same error, again and again.
    """
    while started_by_roslaunch() and not rospy.is_shutdown():
        time.sleep(0.1)


def say(text: str) -> None:
    """Print to stderr, since rospy does not log yet; ignore a stream that cannot be written."""
    try:
        print(f'{_PROGRAM}: {text}', file=sys.stderr, flush=True)
    except (OSError, ValueError):
        pass
