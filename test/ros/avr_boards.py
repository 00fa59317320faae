"""Helpers for tests with emulated AVR boards."""
import os
import sys

import rospy
import tf2_ros

from boards import until

ANNOUNCED = 30.0     # emulated s in which every chunk has been sent several times
_TEST = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
sys.path.insert(0, os.path.join(_TEST, 'firmware'))

from emulated_board import (  # noqa: E402 F401  pylint: disable=wrong-import-position
    EmulatedBoard, build_firmware)


def transforms_with(test, target, source):
    """A tf2 buffer, closed at the end of the test, that already receives this transform.

    It has no transform from before its subscriber was connected.
    """
    buffer = tf2_ros.Buffer()
    test.addCleanup(tf2_ros.TransformListener(buffer).unregister)
    until(lambda: buffer.can_transform(target, source, rospy.Time()),
          'tf has %s in %s' % (source, target))
    return buffer
