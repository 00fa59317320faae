#!/usr/bin/python3
"""Starting a bridge while one of its name is running, or with no master. fleet_test has bridges of
one name in different namespaces."""
import os
import shutil
import signal
import socket
import subprocess
import unittest
from xmlrpc.client import ServerProxy, Transport

import rosgraph
import rospy
import rostest

from boards import PACKAGE, PATIENCE, Bridge, CarBoard, Line, own_folder, program, until
from serial_communication.ros import starting

NAME = '/' + PACKAGE
ELSEWHERE = os.path.join(os.path.dirname(os.path.abspath(__file__)), 'node_elsewhere.py')
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

    def start(self, *arguments, **keywords):
        """Start another bridge with the same name and parameters."""
        self.started.append(Bridge(parameters={'arduino/port': self.line.near},
                                   arguments=arguments, **keywords))
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

    def test_under_roslaunch_it_prints_why_once_and_takes_over_when_the_first_ends(self):
        log = '__log:=' + os.path.join(self.folder, 'log', 'second.log')
        ended = self.start(log)
        ended.wait_for('is already running')
        _seconds, status = ended.end()          # while it waits for the name
        self.assertEqual(status, 0)
        self.assertNotIn('Traceback', ended.output())
        second = self.start(log)
        second.wait_for('is already running')
        self.car.wait_for_heartbeats(150)       # it looks once a second
        self.assert_unharmed()
        self.assertTrue(second.alive, second.output())
        self.assertEqual(len(lines_of(second.output())), 1, second.output())
        self.bridge.end()
        self.car.forget()
        self.car.wait_for_heartbeats(10)
        self.assertTrue(second.alive)
        _seconds, status = second.end()
        self.assertEqual(status, 0)

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

    def test_another_node_at_a_dead_bridges_address_does_not_prevent_a_start(self):
        mine = rospy.get_node_uri()
        rosgraph.Master('/ghost').registerPublisher('/ghost/topic', 'std_msgs/Empty', mine)
        ghost = Bridge('ghost')
        self.started.append(ghost)
        until(lambda: self.master.lookupNode('/ghost') != mine, 'the new one has the name')


class _Impatient(Transport):
    """HTTP with a timeout: another program that got the port of an ended node may not answer."""

    def make_connection(self, host):
        connection = super().make_connection(host)
        connection.timeout = 2
        return connection


class SimultaneousStart(unittest.TestCase):
    """Two bridges of one name: exactly one keeps running, the other ends with status 3."""

    def setUp(self):
        self.folder = own_folder()
        self.master = rosgraph.Master('/same_name_test')
        self.pair = []

    def tearDown(self):
        for bridge in self.pair:
            bridge.kill()
        shutil.rmtree(self.folder)

    def start(self, host='', meets=True, waits=starting._LOCK_PATIENCE, interrupted=False):
        """Start a bridge on a host; with `meets`, it waits once it has found the name free. It
        waits for the lock for that many s. With `interrupted`, it gets SIGINT as it starts
        again."""
        settings = ([f'HOST={host}', f'WAITS={waits}'] + ['MEETING=' + self.folder] * meets
                    + ['INTERRUPTED='] * interrupted)
        self.pair.append(Bridge('twin', {'bus/port': os.path.join(self.folder, 'bus')},
                                before=['env', *settings, ELSEWHERE]))
        return self.pair[-1]

    def have_met(self):
        """How many bridges have found the name free."""
        return len(os.listdir(self.folder))

    def go(self):
        """Let the waiting bridges continue."""
        open(os.path.join(self.folder, 'go'), 'w').close()

    def owner(self, but=''):
        """The process id of the registered bridge, if it answers, and not at the address `but`."""
        try:
            address = self.master.lookupNode('/twin')
            with ServerProxy(address, _Impatient()) as node:
                return node.getPid('/same_name_test')[2] if address != but else None
        except (rosgraph.MasterError, OSError):
            return None

    def displace(self, bridge, before=''):
        """Register another node of its name, once it has registered at another address than
        `before`; return its address."""
        until(lambda: self.owner(before) == bridge.process.pid, 'it has the name')
        address = self.master.lookupNode('/twin')
        rosgraph.Master('/twin').registerSubscriber('/any', 'std_msgs/Empty', 'http://localhost:1/')
        return address

    def assert_one_lives(self):
        until(lambda: len([each for each in self.pair if each.alive]) == 1, 'one of them has ended')
        lives, = [each for each in self.pair if each.alive]
        ended, = [each for each in self.pair if not each.alive]
        said = lines_of(ended.output())
        self.assertEqual(ended.process.returncode, TAKEN, said)
        self.assertEqual([line for line in said if 'is already running' in line], said[-1:])
        until(lambda: self.owner() == lives.process.pid, 'the other one has the name')
        self.assertNotIn('Traceback', ended.output() + lives.output())
        _seconds, status = lives.end()
        self.assertEqual(status, 0, lives.output())
        return lives, ended

    def test_on_one_host_the_second_waits_until_the_first_is_registered(self):
        first = self.start()
        until(lambda: self.have_met() == 1, 'the first one has found the name free')
        second = self.start()
        second.wait_for('another /twin is starting on this host; waiting for it')
        self.assertEqual(self.have_met(), 1)
        self.go()
        lives, ended = self.assert_one_lives()
        self.assertIs(lives, first)
        self.assertEqual(len(lines_of(ended.output())), 2, ended.output())

    def test_on_two_hosts_a_displaced_bridge_checks_the_name_again(self):
        self.start('one')
        self.start('two')
        until(lambda: self.have_met() == 2, 'both have found the name free')
        self.go()
        lives, ended = self.assert_one_lives()
        self.assertIn('another node has registered as /twin', lives.output() + ended.output())

    def test_exactly_one_survives_whatever_the_delay_between_the_starts(self):
        for hosts in ('', ''), ('one', 'two'):
            self.pair = []
            for host in hosts:
                self.start(host, meets=False)
            self.assert_one_lives()

    def test_a_bridge_that_hangs_at_its_start_delays_another_by_10_s_at_most(self):
        self.assertEqual(starting._LOCK_PATIENCE, 10.0)      # s; here it is shorter
        hangs = self.start()
        until(lambda: self.have_met() == 1, 'the first one has found the name free')
        second = self.start(meets=False, waits=2.0)
        until(lambda: self.owner() == second.process.pid, 'the second one has the name')
        self.assertTrue(hangs.alive)

    def test_a_displaced_bridge_starts_again_if_the_name_is_free_and_ctrl_c_ends_it(self):
        bridge = self.start(meets=False)
        first = self.displace(bridge)
        bridge.wait_for('another node has registered as /twin')
        self.displace(bridge, first)     # which may register something else before it ends
        until(lambda: bridge.output().count('another node has registered as /twin') == 2,
              'it is displaced again', PATIENCE)
        _seconds, status = bridge.end(signal.SIGINT)
        self.assertIn(status, (0, -signal.SIGINT), bridge.output())
        self.assertNotIn('Traceback', bridge.output())

    def test_a_signal_that_arrives_as_a_displaced_bridge_starts_again_ends_it(self):
        bridge = self.start(meets=False, interrupted=True)
        self.displace(bridge)
        self.assertIn(bridge.process.wait(PATIENCE), (0, -signal.SIGINT), bridge.output())
        self.assertNotIn('Traceback', bridge.output())

    def test_a_bridge_that_is_displaced_again_and_again_ends(self):
        bridge = Bridge('twin', before=['env', 'SERIAL_COMMUNICATION_DISPLACEMENTS=6'])
        self.pair.append(bridge)
        self.assertEqual(bridge.process.wait(PATIENCE), TAKEN)
        said, = lines_of(bridge.output())
        self.assertIn('another node has registered as /twin 6 times', said)


class WithoutAMaster(unittest.TestCase):
    """A bridge without a master."""

    def test_it_prints_that_it_waits_and_ctrl_c_ends_it_without_a_traceback(self):
        with socket.socket() as taken:          # bound, but not listening
            taken.bind(('127.0.0.1', 0))
            uri = f'http://127.0.0.1:{taken.getsockname()[1]}'
            both = [(number, subprocess.Popen(
                [program('serial_communication_node')], stderr=subprocess.PIPE, text=True,
                env=dict(os.environ, ROS_MASTER_URI=uri)))
                    for number in (signal.SIGINT, signal.SIGTERM)]
            for number, process in both:
                said = process.stderr.readline()
                self.assertIn(f'waiting for the ROS master at {uri}', said)
                self.assertIn('roscore', said)
                process.send_signal(number)
                rest = process.communicate(timeout=PATIENCE)[1]
                self.assertEqual((process.returncode, rest), (0, ''))


if __name__ == '__main__':
    rospy.init_node('same_name_test')
    rostest.rosrun(PACKAGE, 'same_name', '__main__')
