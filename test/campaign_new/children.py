"""Users of the bridge that are processes of their own, since they are stopped or killed:

    listener NAME       subscribes to everything
    caller NAME         calls the lift for each line "DIRECTION DISTANCE"
    latch NAME A B      latches speed A; with a line on stdin, speed B
    driver NAME A       speeds A, A + 1 ... at 20 Hz
    witness             says when the machine woke it late

What a caller was told stands on its stdout, one JSON object a line.
"""
import json
import os
import sys
import time
from typing import List

import rospy

from serial_communication.msg import SpeedPWMCommand
from serial_communication.srv import Lift
from .robot import NODE, TOPICS

LATE = 0.005         # s that make a witness's wake late
_PRIORITY = 10       # real-time, if allowed: below the bridge's
_PERIOD = 0.01       # s


def listener(_arguments: List[str]) -> None:
    """Until it is ended."""
    for topic in [*TOPICS, '/serial_msg', '/diagnostics']:
        rospy.Subscriber(topic.replace('~', NODE + '/'), rospy.AnyMsg, lambda message: None)
    print('ready', flush=True)
    rospy.spin()


def caller(_arguments: List[str]) -> None:
    """Until its stdin ends."""
    print('ready', flush=True)
    for line in sys.stdin:
        answer = rospy.ServiceProxy(NODE + '/lift', Lift)(*map(int, line.split()))
        print(json.dumps({'success': answer.success, 'status': answer.status}), flush=True)


def latch(arguments: List[str]) -> None:
    """It says "connected" when the bridge has connected."""
    publisher = rospy.Publisher(NODE + '/speed', SpeedPWMCommand, queue_size=10, latch=True)
    publisher.publish(value=int(arguments[0]))
    print('ready', flush=True)
    while not publisher.get_num_connections():
        time.sleep(0.01)
    print('connected', flush=True)
    for _line in sys.stdin:
        publisher.publish(value=int(arguments[1]))


def driver(arguments: List[str]) -> None:
    """Until it is ended."""
    publisher = rospy.Publisher(NODE + '/speed', SpeedPWMCommand, queue_size=10)
    print('ready', flush=True)
    value = int(arguments[0])
    while not rospy.is_shutdown():
        publisher.publish(value=value)
        value += 1
        time.sleep(0.05)


def witness() -> None:
    """Sleeps, and says by how much it was woken late: "TIME SECONDS"."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    except OSError:
        pass
    due = time.monotonic()
    while True:
        due = max(due + _PERIOD, time.monotonic())
        time.sleep(max(0.0, due - time.monotonic()))
        late = time.monotonic() - due
        if late > LATE:
            print(f'{due:.4f} {late:.4f}', flush=True)


if __name__ == '__main__':
    if sys.argv[1] == 'witness':
        witness()
    rospy.init_node(sys.argv[2], disable_rosout=True)
    {'listener': listener, 'caller': caller, 'latch': latch,
     'driver': driver}[sys.argv[1]](sys.argv[3:])
