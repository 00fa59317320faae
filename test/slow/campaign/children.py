"""Processes beside the bridge. Most of them are separate processes so that they can be suspended:

    subscriber NAME ... subscribes to these topics
    latching NAME A B   publishes A latched as a command of each type; after a line on stdin B, when
                        A was received
    numbers NAME A      publishes A, A + 1 ... as commands of each type, at 20 Hz
"""
import itertools
import signal
import sys
import time
from typing import Dict
from xmlrpc.client import ServerProxy

import rosgraph
import rospy
from rospy.impl.masterslave import ROSHandler

from .robot import COMMANDS, NODE, command_of, publishers

_PERIOD = 0.01       # s


def subscriber(*topics: str) -> None:
    subscribers = [rospy.Subscriber(topic, rospy.AnyMsg, lambda message: None) for topic in topics]
    while not all(each.get_num_connections() for each in subscribers):
        time.sleep(_PERIOD)
    print('ready', flush=True)
    signal.pause()


def latching(first: str, second: str) -> None:
    of_each = publishers(latch=True)
    _publish(of_each, int(first))
    print('ready', flush=True)
    for _line in sys.stdin:
        while not _bridge_has_received():   # of two that wait, it would use only the newer one
            time.sleep(_PERIOD)
        _publish(of_each, int(second))


def numbers(first: str) -> None:
    of_each = publishers()
    print('ready', flush=True)
    for value in itertools.count(int(first)):
        _publish(of_each, value)
        time.sleep(0.05)


def _publish(of_each: Dict[str, rospy.Publisher], value: int) -> None:
    for name, publisher in of_each.items():
        publisher.publish(command_of(name, value))


def _bridge_has_received() -> bool:
    """Whether the bridge that runs now has received a command of each type of this process."""
    bridge = ServerProxy(rosgraph.Master(rospy.get_name()).lookupNode(NODE))
    ids = [each[0] for each in bridge.getBusInfo('')[2] if each[1] == rospy.get_node_uri()]
    return sum(number > 0 for _topic, connections in bridge.getBusStats('')[2][1]
               for id_, _bytes, number, *_ in connections if id_ in ids) == len(COMMANDS)


if __name__ == '__main__':
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())     # also while it reads stdin
    # A master ends the older one of two nodes with the same name; these go on.
    ROSHandler.shutdown = lambda *_: (1, '', 0)
    rospy.init_node(sys.argv[2], disable_rosout=True, disable_signals=True)
    try:
        roles = {'subscriber': subscriber, 'latching': latching, 'numbers': numbers}
        roles[sys.argv[1]](*sys.argv[3:])
    finally:
        rospy.signal_shutdown('ended')
