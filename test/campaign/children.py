"""Users of the bridge that are processes of their own, since they are stopped:

    listener NAME       subscribes to everything
    caller NAME         calls the lift for each line "DIRECTION DISTANCE"
    latch NAME A B      latches speed A; with a line on stdin, speed B
    driver NAME A       speeds A, A + 1 ... at 20 Hz
    witness             says when the machine woke it late, by how many seconds
"""
import itertools
import signal
import sys
import time

import rospy

from serial_communication.msg import SpeedPWMCommand
from serial_communication.srv import Lift
from .robot import NODE, TOPICS

LATE = 0.01          # s that make a witness's wake late
_PERIOD = 0.01       # s


def listener() -> None:
    """Until it is ended, as all of them."""
    for topic in [*TOPICS, '/serial_msg', '/diagnostics']:
        rospy.Subscriber(topic.replace('~', NODE + '/'), rospy.AnyMsg, lambda message: None)
    print('ready', flush=True)
    signal.pause()


def caller() -> None:
    """What it was told stands on its stdout."""
    print('ready', flush=True)
    for line in sys.stdin:
        answer = rospy.ServiceProxy(NODE + '/lift', Lift)(*map(int, line.split()))
        print(f'told {answer.success}', flush=True)


def latch(first: str, second: str) -> None:
    """It says "connected" when the bridge has connected."""
    publisher = rospy.Publisher(NODE + '/speed', SpeedPWMCommand, queue_size=10, latch=True)
    publisher.publish(value=int(first))
    print('ready', flush=True)
    while not publisher.get_num_connections():
        time.sleep(0.01)
    print('connected', flush=True)
    for _line in sys.stdin:
        publisher.publish(value=int(second))


def driver(first: str) -> None:
    """Whether anybody listens or not."""
    publisher = rospy.Publisher(NODE + '/speed', SpeedPWMCommand, queue_size=10)
    print('ready', flush=True)
    for value in itertools.count(int(first)):
        publisher.publish(value=value)
        time.sleep(0.05)


def witness() -> None:
    """As ordinary as the bridge's threads, with whom its heartbeat shares Python's lock."""
    due = time.monotonic()
    while True:
        due = max(due + _PERIOD, time.monotonic())
        time.sleep(max(0.0, due - time.monotonic()))
        late = time.monotonic() - due
        if late > LATE:
            print(f'{due:.4f} {late:.4f}', flush=True)


if __name__ == '__main__':
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())     # also where it waits for stdin
    if sys.argv[1] == 'witness':
        witness()
    rospy.init_node(sys.argv[2], disable_rosout=True, disable_signals=True)
    try:
        {'listener': listener, 'caller': caller, 'latch': latch,
         'driver': driver}[sys.argv[1]](*sys.argv[3:])
    finally:
        rospy.signal_shutdown('ended')
