#!/usr/bin/python3
"""Prints each status of a link as it comes on /diagnostics: its name, then OK, WARN or ERROR."""
import rospy
from diagnostic_msgs.msg import DiagnosticArray

WORDS = ('OK', 'WARN', 'ERROR', 'STALE')


def show(message: DiagnosticArray) -> None:
    """A line for each link; the updater's own word, that the node starts, has no values."""
    for status in message.status:
        if status.values:
            # Some versions of genpy have bytes here.
            level = ord(status.level) if isinstance(status.level, bytes) else status.level
            if status.message.startswith('heartbeat gap'):
                level = 0       # a busy machine makes heartbeats late: that is no fault of a page
            print(status.name.rpartition(': ')[2].split()[0], WORDS[level], flush=True)


rospy.init_node('levels', anonymous=True)
rospy.Subscriber('/diagnostics', DiagnosticArray, show)
rospy.spin()
