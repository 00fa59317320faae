#!/usr/bin/python3
"""Starting a bridge while one of its name is running, or with no master. fleet_test has bridges of
one name in different namespaces."""
import os
import shutil
import signal
import socket
import subprocess
import unittest

import rosgraph
import rospy
import rostest

from boards import PACKAGE, PATIENCE, Bridge, CarBoard, Line, own_folder, program, until

NAME = '/' + PACKAGE
TAKEN = 3                # exit status if a node of the same name is running


def lines_of(text):
    """The lines that are not empty."""
    return [line for line in text.split('\n') if line.strip()]


class WhileOneRuns(unittest.TestCase):
    """A running bridge with a car. It must keep running, without a late heartbeat.

    If a test ends or replaces the bridge, the next test starts a new one.
    """

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
        """The same node is running, no heartbeat was late, and the port was not opened again."""
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

    def test_a_killed_or_suspended_bridge_does_not_prevent_a_start(self):
        for number in signal.SIGKILL, signal.SIGSTOP:
            old = self.bridge
            old.process.send_signal(number)
            if number == signal.SIGKILL:
                old.process.wait(PATIENCE)
            self.bridge = self.start()
            until(lambda: self.master.lookupNode(NAME) != self.address, 'the new one has the name')
            self.address = self.master.lookupNode(NAME)
            old.kill()
            self.car.forget()
            self.car.wait_for_heartbeats(10)


class WithoutAMaster(unittest.TestCase):
    """A bridge without a master."""

    def test_a_signal_ends_it_while_it_waits(self):
        with socket.socket() as taken:          # bound, but not listening
            taken.bind(('127.0.0.1', 0))
            uri = f'http://127.0.0.1:{taken.getsockname()[1]}'
            both = [(number, subprocess.Popen(
                [program('serial_communication_node')], stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT, text=True,
                env=dict(os.environ, ROS_MASTER_URI=uri)))
                    for number in (signal.SIGINT, signal.SIGTERM)]
            for number, process in both:
                self.assertIn(uri, process.stdout.readline())
                process.send_signal(number)
                rest = process.communicate(timeout=PATIENCE)[0]
                self.assertEqual((process.returncode, rest), (0, ''))


if __name__ == '__main__':
    rospy.init_node('same_name_test')
    rostest.rosrun(PACKAGE, 'same_name', '__main__')
