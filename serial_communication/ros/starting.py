"""What comes before the node registers or opens anything: its command line is looked at, a master
waited for, and a node of its name that runs already left alone."""
import errno
import os
import random
import re
import signal
import socket
import sys
import threading
import time
from typing import List, Optional

import rosgraph
import rospy

from .master import by_roslaunch, full_name, living_node, wait_for_master

NAME_TAKEN = 3            # exit status of a node whose name belongs to one that lives
WRONG_ARGUMENTS = 2
_AGAIN = 10.0             # s from one complaint to the next where roslaunch starts it again
_LOCK_EVERY, _LOCK_PATIENCE = 0.05, 10.0    # s from one try to the next, and until it goes on
_LONGEST_ADDRESS = 108    # bytes of a Unix socket's
_DISPLACEMENTS = 'SERIAL_COMMUNICATION_DISPLACEMENTS'    # from one start to the next
_MOST_DISPLACEMENTS = 5   # in a row: then the other one lives, and cannot be seen from here
_LONG_LIFE = 60.0         # s after which a displacement is the first one again
_REASON = 0.4             # s that the reason of an end that has begun is waited for
_PROGRAM = 'serial_communication_node'
_ARGUMENT = re.compile(r'[\w~/]+:=')    # a remapping, a parameter or a name, as ROS has them
_USAGE = f"""\
usage: {_PROGRAM} [__name:=NAME] [__ns:=NAMESPACE] [_PARAMETER:=VALUE …] [OLD:=NEW …]

The node that connects the serial links of a robot with ROS. It takes ROS's own arguments and
nothing else; its parameters stand in config/bridge.yaml. Some ways to start it:
  roslaunch serial_communication bridge.launch --ros-args     what the launch file takes
  roslaunch serial_communication bridge.launch sim:=true      with simulated boards
  rosrun serial_communication {_PROGRAM} _bus/port:=/dev/ttyS0

Exit status 0: it was told to end; 1: a parameter is wrong, or something failed, which it has
said; {WRONG_ARGUMENTS}: wrong arguments; {NAME_TAKEN}: a node of its name runs already.
With a wrong parameter and by roslaunch, which would start it again, it waits until it is told to
end.
"""


def check_arguments(arguments: List[str]) -> None:
    """End the process with its usage if that was asked for, or an argument is none of ROS's."""
    if '-h' in arguments or '--help' in arguments:
        print(_USAGE, end='')
        sys.exit(0)
    for argument in arguments:
        if not _ARGUMENT.match(argument):
            print(f'{_PROGRAM}: {argument!r} is none of its arguments\n{_USAGE}', end='',
                  file=sys.stderr)
            sys.exit(WRONG_ARGUMENTS)


class Start:
    """One start of the node, and what becomes of it if another one takes its name.

    Of two that start in the same moment exactly one is to live. On one host a lock keeps one
    waiting until the other is registered and can be seen. Between hosts both may find the name
    free; the master then ends one or both of them. One that was ended so starts again, after a
    random time, and looks again.
    """

    def __init__(self, default_name: str) -> None:
        self.stopping = threading.Event()       # the process was told to end
        self._name = full_name(default_name)
        self._lock = _NameLock(self._name)
        self._began = time.monotonic()
        self._displaced = False
        self._reason_known = threading.Event()

    def may_begin(self) -> Optional[int]:
        """Wait for a master, and look whether the name is free there.

        SIGINT and SIGTERM end the waiting; rospy.init_node takes them over, and passes them on.

        Returns:
            None: call rospy.init_node, and `registered` after it; otherwise the status to end
            with.
        """
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: self.stopping.set())
        if not wait_for_master(self.stopping, _say):
            return 0
        rospy.core.add_preshutdown_hook(self._ends)
        status = self._after_displacements() or self._look()
        return 0 if self.stopping.is_set() else status

    def registered(self) -> None:
        """rospy.init_node has returned: who looks for this node sees it."""
        self._lock.release()

    def start_again_if_displaced(self) -> None:
        """Where another node has taken the name: begin anew in this process; does not return."""
        if rospy.core.is_shutdown_requested():
            self._reason_known.wait(_REASON)
        if not self._displaced or self.stopping.is_set():
            return
        before = _displacements() if time.monotonic() - self._began < _LONG_LIFE else 0
        try:
            # rospy cannot be started a second time in one run of the interpreter.
            os.execve(sys.executable, [sys.executable, *sys.argv],
                      {**os.environ, _DISPLACEMENTS: str(before + 1)})
        except OSError:
            os._exit(NAME_TAKEN)

    def end_at_last(self, status: int) -> None:
        """End the process although something hangs."""
        self.start_again_if_displaced()
        os._exit(status)

    def _ends(self, reason: str) -> None:
        self._displaced = 'new node registered with same name' in reason
        self._reason_known.set()
        if self._displaced:
            rospy.logwarn(f'another node has registered as {self._name}: this one ends, and looks '
                          'in a few seconds whether that one lives')

    def _after_displacements(self) -> Optional[int]:
        """Wait for a random time if this process was displaced; the status to end with, if any."""
        number = _displacements()
        if number > _MOST_DISPLACEMENTS:
            _say(f'another node has registered as {self._name} {number} times, and does not answer '
                 'here; is it reachable from this host (ROS_IP, ROS_HOSTNAME)? Give one of them '
                 'another name')
            return NAME_TAKEN
        if number:
            self.stopping.wait(random.uniform(0.5, 4.0 * number))
        return None

    def _look(self) -> Optional[int]:
        """Say that a node of this name lives, if one does; the status to end with then, or None.

        A person at a terminal has the answer at once. roslaunch starts the node again as soon as
        it ends: there it waits, and goes on if the other one ends meanwhile.
        """
        deadline = None
        while not self.stopping.is_set():
            self._lock.acquire(self.stopping)
            address = living_node(self._name)
            if not address:
                return None
            self._lock.release()
            if deadline is None:
                deadline = time.monotonic() + _AGAIN
                _say(f'{self._name} runs already ({address}); end that one first (rosnode kill '
                     f'{self._name}), or give this one another name (name:=NAME of the launch '
                     'file, __name:=NAME of the node)')
            if not by_roslaunch() or time.monotonic() >= deadline:
                return NAME_TAKEN
            self.stopping.wait(1.0)
        return 0


class _NameLock:
    """Held by one process of this host, from its look at the name until it is registered.

    It is an abstract Unix socket: the kernel frees it however its process ends, no file stays
    behind, and it works between users.
    """

    def __init__(self, name: str) -> None:
        # Without the master's host, for which there may be several names. Where two are meant,
        # one start waits for another for no reason; no more.
        _, port = rosgraph.network.parse_http_host_and_port(rosgraph.get_master_uri())
        self._name = name
        self._address = f'\0{_PROGRAM} {port} {name}'.encode()[:_LONGEST_ADDRESS]
        self._socket: Optional[socket.socket] = None

    def acquire(self, stopping: threading.Event) -> None:
        """Wait for it; for 10 s at most, since its holder may hang."""
        began, said = time.monotonic(), False
        while not self._bind() and not stopping.wait(_LOCK_EVERY):
            waited = time.monotonic() - began
            if waited > _LOCK_PATIENCE:
                return
            if waited > 1.0 and not said:
                said = True
                _say(f'another {self._name} is starting on this host; waiting for it')

    def release(self) -> None:
        """Let another one have it."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _bind(self) -> bool:
        """Whether it is ours now, or cannot be had at all."""
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
    """How often in a row this process was displaced."""
    return int(os.environ.get(_DISPLACEMENTS, '0'))


def linger() -> None:
    """Call this before the node ends because of a mistake that it has logged.

    roslaunch starts a node with respawn again, with the same parameters, and each time the node
    would log the same mistake: there it waits, doing nothing, until it is told to end.
    """
    while by_roslaunch() and not rospy.is_shutdown():
        time.sleep(0.1)


def _say(text: str) -> None:
    """On stderr, which is all there is before rospy logs; whether it can be written or not."""
    try:
        print(f'{_PROGRAM}: {text}', file=sys.stderr, flush=True)
    except (OSError, ValueError):
        pass
