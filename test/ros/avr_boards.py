"""Helpers for tests with emulated AVR boards: an emulated board with a bridge, and tf."""
import os
import sys
import time
import unittest
from contextlib import contextmanager

import rospy
import tf2_ros

from boards import PACKAGE, Bridge, until

ANNOUNCED = 30.0     # emulated s in which every chunk has been sent several times
_TEST = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
sys.path.insert(0, os.path.join(_TEST, 'firmware'))

from emulated_board import (  # noqa: E402  pylint: disable=wrong-import-position
    EmulatedBoard, build_firmware)


class OnBoard(unittest.TestCase):
    """An emulated board in a world at rest, and a bridge with only that link."""

    WORLD = ''           # car, ctrl or range
    IMAGE = None         # the firmware; None: the one that belongs into the world
    LINK = ''            # the link's name in the parameters
    PARAMETERS = {}      # of the bridge, without the port

    @classmethod
    def setUpClass(cls):
        cls.board = EmulatedBoard(build_firmware(), cls.WORLD, image=cls.IMAGE)
        cls.addClassCleanup(cls.board.close)
        cls.bridge = None
        cls.addClassCleanup(cls.end_bridge)
        cls.start_bridge()

    @classmethod
    def start_bridge(cls):
        """Start a bridge, unless one is running."""
        if cls.bridge is None or not cls.bridge.alive:
            cls.bridge = Bridge(parameters=dict(cls.PARAMETERS,
                                                **{cls.LINK + '/port': cls.board.port}))

    @classmethod
    def end_bridge(cls):
        """End the bridge, even if it is suspended or dead."""
        if cls.bridge is None:
            return
        try:
            cls.bridge.end()
        finally:
            if 'Traceback' in cls.bridge.output():
                raise AssertionError(cls.bridge.output())

    def setUp(self):
        self.start_bridge()

    def tearDown(self):
        self.assertEqual(self.board.get('rx_overruns'), 0, 'the bridge sends too fast')

    def own(self, name):
        """A private name of the bridge."""
        return '/%s/%s' % (PACKAGE, name)

    def collect(self, topic):
        """A Topic, closed at the end of the test."""
        self.addCleanup(topic.close)
        return topic

    def until_is(self, name, value, doing=None):
        """Wait until a quantity of the board's world has that value."""
        until(lambda: self.board.get(name) == value,
              '%s is %g' % (name, value), doing=doing, every=0.005)

    def until_emulated(self, seconds):
        """Wait for a number of seconds of emulated time."""
        end = self.board.time + seconds
        until(lambda: self.board.time >= end, '%g emulated seconds' % seconds, every=0.0005)

    @contextmanager
    def about(self, **case):
        """Name the case in failures. (rostest does not report failures in a subTest.)"""
        try:
            yield
        except AssertionError as error:
            raise AssertionError('%s: %s' % (case, error)) from error


def until_announced(board, topic):
    """Wait until the bridge publishes a topic whose row an emulated board announces.

    A board sends a chunk a second, in its own time, which passes slowly where the emulator gets
    little processor time. So the limit is in emulated seconds.
    """
    end = board.time + ANNOUNCED
    while not topic.publishers:
        assert board.time < end, f'{topic.name} is not announced in {ANNOUNCED:g} emulated seconds'
        time.sleep(0.05)


def transforms_with(test, target, source):
    """A tf2 buffer, closed at the end of the test, that already receives this transform.

    It has no transform from before its subscriber was connected.
    """
    buffer = tf2_ros.Buffer()
    test.addCleanup(tf2_ros.TransformListener(buffer).unregister)
    until(lambda: buffer.can_transform(target, source, rospy.Time()),
          'tf has %s in %s' % (source, target))
    return buffer


def upward(orientation):
    """The direction "up" in the frame of a body with this orientation (w, x, y, z)."""
    w, x, y, z = orientation
    return 2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z
