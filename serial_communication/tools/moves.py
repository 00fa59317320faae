"""Drives the simulated car and moves lift and gimbal, over and over, for the demo.

It commands only a bridge whose ports are in the given folder, that of the simulated boards: another
one of that name may drive a robot.
"""
import argparse
import itertools
import math
import threading
import time
from typing import Callable

import rospy

from serial_communication.msg import SpeedPWMCommand, SteeringPWMCommand
from serial_communication.srv import Gimbal, Lift

from .watch.calls import call
from .watch.topics import NODE

_CALL_EVERY = 3.0       # s between two calls
_COMMAND_EVERY = 0.1    # s between two commands for the car

# Direction, and mm or degrees. Each move is undone, so that none runs into an end stop.
_PLAN = (Lift, 0, 20), (Gimbal, 0, 15), (Lift, 1, 20), (Gimbal, 1, 15)


def main() -> None:
    """Move until the node ends."""
    parser = argparse.ArgumentParser(prog='moves', description=__doc__)
    parser.add_argument('folder', metavar='FOLDER', help='with the ports of the simulated boards')
    folder = parser.parse_args(rospy.myargv()[1:]).folder
    rospy.init_node('moves')

    def is_simulated(link: str) -> bool:
        return str(rospy.get_param_cached(f'{NODE}/{link}/port', '')).startswith(folder + '/')

    threading.Thread(target=_call, args=(is_simulated,), daemon=True).start()
    _drive(is_simulated)


def _call(is_simulated: Callable[[str], bool]) -> None:
    for service, direction, amount in itertools.cycle(_PLAN):
        began = time.monotonic()
        if is_simulated('bus'):
            name = service.__name__.lower()
            answer = call(f'{NODE}/{name}', service, service._request_class(direction, amount),
                          began + _CALL_EVERY)
            rospy.loginfo('%s: %s', name, answer.words)
        time.sleep(max(0.0, began + _CALL_EVERY - time.monotonic()))


def _drive(is_simulated: Callable[[str], bool]) -> None:
    """Drive in gentle curves."""
    speed = rospy.Publisher(NODE + '/speed', SpeedPWMCommand, queue_size=1)
    steering = rospy.Publisher(NODE + '/steering', SteeringPWMCommand, queue_size=1)
    began = time.monotonic()
    while not rospy.is_shutdown():
        if is_simulated('arduino'):
            driven = time.monotonic() - began
            speed.publish(value=round(300 + 100 * math.sin(driven / 4)))
            steering.publish(value=round(1500 + 200 * math.sin(driven * 2 * math.pi / 20)))
        time.sleep(_COMMAND_EVERY)
