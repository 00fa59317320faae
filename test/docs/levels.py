#!/usr/bin/python3
"""Prints each link status from /diagnostics: the link's name, then OK, WARN or ERROR."""
import rospy
from diagnostic_msgs.msg import DiagnosticArray

WORDS = ('OK', 'WARN', 'ERROR', 'STALE')


def show(message: DiagnosticArray) -> None:
    """Print a line for each link. The updater's notice that the node starts has no values."""
    for status in message.status:
        if status.values:
            # Some versions of genpy have bytes here.
            level = ord(status.level) if isinstance(status.level, bytes) else status.level
            if status.message.startswith('heartbeat gap'):
                level = 0       # heartbeats are late on a busy machine, which is no error of a page
            print(status.name.rpartition(': ')[2].split()[0], WORDS[level], flush=True)


rospy.init_node('levels', anonymous=True)
rospy.Subscriber('/diagnostics', DiagnosticArray, show)
rospy.spin()
