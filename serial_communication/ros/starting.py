"""The command line of the node, and a forced end of the process."""
import argparse
import os
import re
import threading
from typing import List

NAME_TAKEN = 3            # exit status if a node of the same name is running
_ARGUMENT = re.compile(r'[\w~/]+:=')    # ROS: a remapping, a parameter, or a special key (__name)
_DESCRIPTION = f"""\
The node that connects the serial links of a robot to ROS, usually started by bridge.launch. It
takes ROS's arguments only; config/bridge.yaml documents its parameters.

Exit status 0: it was stopped; 1: a parameter is wrong, or something failed (see the log);
2: wrong arguments; {NAME_TAKEN}: a node of its name is already running.
With a wrong parameter, a node that roslaunch started does not exit, since roslaunch would start
it again: it waits until it is stopped.
"""


def check_arguments(arguments: List[str]) -> None:
    """Print the usage and exit if it was asked for, or if an argument is not one of ROS's."""
    argparse.ArgumentParser(
        'serial_communication_node', description=_DESCRIPTION,
        usage='%(prog)s [__name:=NAME] [__ns:=NAMESPACE] [_PARAMETER:=VALUE …] [OLD:=NEW …]',
        formatter_class=argparse.RawDescriptionHelpFormatter).parse_args(
            [each for each in arguments if not _ARGUMENT.match(each)])


def end_within(seconds: float, status: int) -> None:
    """End the process so many seconds later, whatever hangs; the first call counts."""
    timer = threading.Timer(seconds, os._exit, [status])
    timer.daemon = True
    timer.start()
