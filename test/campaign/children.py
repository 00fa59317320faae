"""Processes beside the bridge. Most of them are separate processes so that they can be suspended:

    subscriber NAME     subscribes to all topics
    caller NAME         calls the lift for each line "DIRECTION DISTANCE" of stdin; prints results
    latching NAME A B   publishes speed A latched, prints "connected" once the bridge has connected;
                        after a line on stdin publishes speed B
    speeds NAME A       publishes speeds A, A + 1 ... at 20 Hz
    sleeper             prints when it was woken late, and by how many seconds
"""
import itertools
import signal
import sys
import time

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
    while not publisher.impl.message_data_sent:     # rospy sends the latched one after it connects
        time.sleep(0.01)
    print('connected', flush=True)
    for _line in sys.stdin:
        publisher.publish(value=int(second))


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
