"""Helpers for tests with emulated AVR boards: an emulated board with a bridge, and rotations."""
import os
import pty
import select
import sys
import threading
import tty
import unittest
from contextlib import contextmanager
from math import acos, cos, degrees, radians, sin, sqrt

import serial

from boards import PACKAGE, SPEED_0_PACKET, Bridge, until

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

    def kill_bridge(self):
        """Kill the bridge with SIGKILL, so that it sends nothing more."""
        self.bridge.process.kill()
        self.bridge.process.wait(10)

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


class LossyLine(threading.Thread):
    """A line to a board's port that loses the first SPEED 0 after each different speed."""

    def __init__(self, port):
        super().__init__(name='lossy line', daemon=True)
        self._board = serial.Serial(port, 115200, timeout=0, exclusive=True)
        self._line, slave = pty.openpty()
        tty.setraw(slave)
        self.near = os.ttyname(slave)
        self.lost = 0
        self._slave = slave      # kept open, since the line must not hang up when the bridge ends
        self._moving = False
        self._packet = b''
        self._ending = threading.Event()
        self.start()

    def close(self):
        self._ending.set()
        self.join(5)
        self._board.close()
        os.close(self._line)
        os.close(self._slave)

    def run(self):
        while not self._ending.is_set():
            ready, _, _ = select.select([self._line, self._board], [], [], 0.05)
            if self._board in ready:
                os.write(self._line, self._board.read(4096))
            if self._line in ready:
                self._pass_on(os.read(self._line, 4096))

    def _pass_on(self, data):
        *packets, self._packet = (self._packet + data).split(b'\0')
        for packet in packets:
            packet += b'\0'
            if packet == SPEED_0_PACKET and self._moving:
                self._moving = False
                self.lost += 1
                continue
            if packet[1:2] == b'\x04':
                self._moving = packet != SPEED_0_PACKET
            self._board.write(packet)


# -- rotations ----------------------------------------------------------------------------


def times(p, q):
    """The product p q of two quaternions w, x, y, z: rotation q, then p."""
    a, b, c, d = p
    w, x, y, z = q
    return (a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x, a * z + b * y - c * x + d * w)


def turn(yaw, pitch, roll):
    """The quaternion of yaw about z, then pitch about y, then roll about x, in degrees."""
    def about(axis, angle):
        half = radians(angle) / 2
        return (cos(half),) + tuple(sin(half) * part for part in axis)
    return times(times(about((0, 0, 1), yaw), about((0, 1, 0), pitch)), about((1, 0, 0), roll))


def upward(orientation):
    """The direction "up" in the frame of a body with this orientation: x, y, z."""
    w, x, y, z = orientation
    return times(times((w, -x, -y, -z), (0, 0, 0, 1)), orientation)[1:]


def apart(p, q):
    """The angle between two orientations, in degrees."""
    norm = sqrt(sum(part * part for part in p) * sum(part * part for part in q))
    return degrees(2 * acos(min(1.0, abs(sum(a * b for a, b in zip(p, q))) / norm)))
