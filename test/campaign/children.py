"""Processes beside the bridge. Most of them are separate processes so that they can be suspended:

    subscriber NAME     subscribes to all topics
    caller NAME         calls the lift for each line "DIRECTION DISTANCE" of stdin; prints results
    latching NAME A B   publishes speed A latched; after a line on stdin B, when A was received
    speeds NAME A       publishes speeds A, A + 1 ... at 20 Hz
    sleeper             prints when it was woken late, and by how many seconds
"""
import itertools
import signal
import sys
import time
from xmlrpc.client import ServerProxy

import rosgraph
import rospy

from serial_communication.msg import SpeedPWMCommand
from serial_communication.srv import Lift
from .logs import LATE
from .robot import NODE, TOPICS

_PERIOD = 0.01       # s


def subscriber() -> None:
    for topic in [*TOPICS, '/serial_msg', '/diagnostics']:
        rospy.Subscriber(topic.replace('~', NODE + '/'), rospy.AnyMsg, lambda message: None)
    print('ready', flush=True)
    signal.pause()


def caller() -> None:
    print('ready', flush=True)
    for line in sys.stdin:
        response = rospy.ServiceProxy(NODE + '/lift', Lift)(*map(int, line.split()))
        print(f'returned {response.success}', flush=True)


def latching(first: str, second: str) -> None:
    publisher = rospy.Publisher(NODE + '/speed', SpeedPWMCommand, queue_size=10, latch=True)
    publisher.publish(value=int(first))
    print('ready', flush=True)
    for _line in sys.stdin:
        while not _bridge_has_received():   # of two that wait, it would use only the newer one
            time.sleep(_PERIOD)
        publisher.publish(value=int(second))


def _bridge_has_received() -> bool:
    """Return whether the bridge that runs now has received a message of this process."""
    bridge = ServerProxy(rosgraph.Master(rospy.get_name()).lookupNode(NODE))
    ids = [each[0] for each in bridge.getBusInfo('')[2] if each[1] == rospy.get_node_uri()]
    return any(number for _topic, connections in bridge.getBusStats('')[2][1]
               for id_, _bytes, number, *_ in connections if id_ in ids)


def speeds(first: str) -> None:
    publisher = rospy.Publisher(NODE + '/speed', SpeedPWMCommand, queue_size=10)
    print('ready', flush=True)
    for value in itertools.count(int(first)):
        publisher.publish(value=value)
        time.sleep(0.05)


def sleeper() -> None:
    """Has ordinary priority, as the bridge's threads that hold Python's lock have."""
    due = time.monotonic()
    while True:
        due = max(due + _PERIOD, time.monotonic())
        time.sleep(max(0.0, due - time.monotonic()))
        late = time.monotonic() - due
        if late > LATE:
            print(f'{due:.4f} {late:.4f}', flush=True)


if __name__ == '__main__':
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())     # also while it reads stdin
    if sys.argv[1] == 'sleeper':
        sleeper()
    rospy.init_node(sys.argv[2], disable_rosout=True, disable_signals=True)
    try:
        {'subscriber': subscriber, 'caller': caller, 'latching': latching,
         'speeds': speeds}[sys.argv[1]](*sys.argv[3:])
    finally:
        rospy.signal_shutdown('ended')
