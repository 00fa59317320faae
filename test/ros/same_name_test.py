#!/usr/bin/python3
"""Starting a bridge while one of its name is running."""
import os
import shutil
import unittest

import rosgraph
import rospy
import rostest

from boards import PACKAGE, PATIENCE, Bridge, CarBoard, Line, own_folder, until

NAME = '/' + PACKAGE
TAKEN = 3                # exit status if a node of the same name is running


def lines_of(text):
    """The lines that are not empty."""
    return [line for line in text.split('\n') if line.strip()]


class WhileOneRuns(unittest.TestCase):
    """A running bridge with a car. It must keep running."""

    @classmethod
    def setUpClass(cls):
        cls.folder = own_folder()
        cls.line = Line(os.path.join(cls.folder, 'arduino')).plug()
        cls.car = CarBoard(cls.line.far)
        cls.first = None

    @classmethod
    def tearDownClass(cls):
        if cls.first is not None:
            cls.first.process.kill()
            cls.first.process.wait(PATIENCE)
        cls.car.close()
        cls.line.unplug()
        shutil.rmtree(cls.folder)

    def setUp(self):
        if self.first is None or not self.first.alive:
            type(self).first = Bridge(parameters={
                'arduino/port': self.line.near, 'arduino/network_silence': 0.0})
        self.bridge = self.first
        self.car.wait_for_heartbeats(50)
        self.master = rosgraph.Master('/same_name_test')
        self.address = until(lambda: self.master.lookupNode(NAME), 'the bridge is registered')
        self.started = []

    def tearDown(self):
        for bridge in self.started:
            bridge.kill()

    def start(self):
        """Start another bridge with the same name and parameters."""
        self.started.append(Bridge(parameters={'arduino/port': self.line.near}))
        return self.started[-1]

    def assert_unharmed(self):
        """The same node is running, and the port was not opened again."""
        self.car.wait_for_heartbeats(50)
        self.assertTrue(self.bridge.alive, self.bridge.output())
        self.assertEqual(self.master.lookupNode(NAME), self.address)
        self.assertNotIn('another program', self.bridge.output())
        self.assertEqual(self.car.speeds, [])

    def test_a_second_bridge_prints_why_and_ends_at_once(self):
        second = self.start()
        self.assertEqual(second.process.wait(PATIENCE), TAKEN)
        said, = lines_of(second.output())
        self.assertIn(f'{NAME} is already running ({self.address})', said)
        self.assertIn(f'rosnode kill {NAME}', said)
        self.assert_unharmed()


if __name__ == '__main__':
    rospy.init_node('same_name_test')
    rostest.rosrun(PACKAGE, 'same_name', '__main__')
