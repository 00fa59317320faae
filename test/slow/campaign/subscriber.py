"""Subscribes to the topics of its arguments: a process of its own, so that it can be suspended."""
import signal
import sys
import time

import rospy

if __name__ == '__main__':
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
    rospy.init_node('storm_subscriber', anonymous=True, disable_rosout=True, disable_signals=True)
    subscribers = [rospy.Subscriber(topic, rospy.AnyMsg, lambda message: None)
                   for topic in sys.argv[1:]]
    while not all(each.get_num_connections() for each in subscribers):
        time.sleep(0.01)
    print('ready', flush=True)
    signal.pause()
