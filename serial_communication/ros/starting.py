"""What comes before the node registers or opens anything: its command line is looked at, a master
waited for, and a node of its name that runs already left alone."""
import re
import signal
import sys
import threading
import time
from typing import List, Optional

import rospy

from .master import by_roslaunch, full_name, living_node, wait_for_master

NAME_TAKEN = 3            # exit status of a node whose name belongs to one that lives
WRONG_ARGUMENTS = 2
_AGAIN = 10.0             # s from one complaint to the next where roslaunch starts it again
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


def may_start(default_name: str) -> Optional[int]:
    """Wait for a master, and look whether the name is free there.

    SIGINT and SIGTERM end the waiting; they are left to rospy.init_node, which takes them over.

    Returns:
        None: go on; otherwise the status to end with.
    """
    stopping = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopping.set())
    if not wait_for_master(stopping, _say):
        return 0
    name = full_name(default_name)
    status = _leave_alone(name, stopping)
    return 0 if stopping.is_set() else status


def _leave_alone(name: str, stopping: threading.Event) -> Optional[int]:
    """Say that a node of this name lives, if one does; the status to end with then, or None.

    A person at a terminal has the answer at once. roslaunch starts the node again as soon as it
    ends: there it waits, and goes on if the other one ends meanwhile.
    """
    address = living_node(name)
    if not address:
        return None
    _say(f'{name} runs already ({address}); end that one first (rosnode kill {name}), or give '
         'this one another name (name:=NAME of the launch file, __name:=NAME of the node)')
    deadline = time.monotonic() + _AGAIN
    while by_roslaunch() and time.monotonic() < deadline and not stopping.wait(1.0):
        if not living_node(name):
            return None
    return NAME_TAKEN


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
