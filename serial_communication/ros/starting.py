"""The command line, a forced end of the process, and lines that are printed before it can log."""
import os
import queue
import re
import sys
import threading
import time
from pathlib import Path
from typing import Callable, List

NAME_TAKEN = 3            # exit status if a node of the same name is running
WRONG_ARGUMENTS = 2       # exit status
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


def last_resort(seconds: float) -> Callable[[int], None]:
    """Return a function that ends the process so many seconds later with a status, whatever hangs.

    Only its first call counts. A handler of a signal may call it.
    """
    statuses: 'queue.SimpleQueue[int]' = queue.SimpleQueue()

    def run() -> None:
        status = statuses.get()
        time.sleep(seconds)
        os._exit(status)

    threading.Thread(target=run, name='last resort', daemon=True).start()
    return statuses.put


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


def say(text: str) -> None:
    """Print to stderr, since rospy does not log yet; ignore a stream that cannot be written."""
    try:
        print(f'{_PROGRAM}: {text}', file=sys.stderr, flush=True)
    except (OSError, ValueError):
        pass
