#!/usr/bin/python3
"""Starting a bridge while one of its name is running; --help, wrong arguments, no master."""
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
from heartbeats import HeartbeatWatch

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
            cls.first.process.wait(10)
        cls.car.close()
        cls.line.unplug()
        shutil.rmtree(cls.folder)

    def setUp(self):
        if self.first is None or not self.first.alive:
            type(self).first = Bridge(parameters={'arduino/port': self.line.near})
        self.bridge = self.first
        self.car.wait_for_heartbeats(50)
        self.master = rosgraph.Master('/same_name_test')
        self.address = until(lambda: self.master.lookupNode(NAME), 'the bridge is registered')
        self.started = []
        self.heartbeats = HeartbeatWatch(self.car, self.bridge.process.pid)

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
        self.heartbeats.check()
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
        second = self.start('__log:=' + os.path.join(self.folder, 'log', 'second.log'))
        second.wait_for('is already running')
        self.car.wait_for_heartbeats(300)       # three seconds
        self.assertTrue(second.alive, second.output())
        self.assertEqual(len(lines_of(second.output())), 1, second.output())
        self.assert_unharmed()
        self.bridge.end()
        self.car.forget()
        self.car.wait_for_heartbeats(10)
        self.assertTrue(second.alive)
        _seconds, status = second.end()
        self.assertEqual(status, 0)

    def test_ctrl_c_ends_a_bridge_that_waits_for_the_name(self):
        second = self.start('__log:=' + os.path.join(self.folder, 'log', 'second.log'))
        second.wait_for('is already running')
        _seconds, status = second.end(signal.SIGINT)
        self.assertEqual(status, 0)
        self.assertNotIn('Traceback', second.output())
        self.assert_unharmed()

    def test_another_name_or_namespace_is_another_node(self):
        for arguments, name in ((['__name:=other'], '/other'), (['__ns:=/robot'], '/robot' + NAME)):
            other = subprocess.Popen([program('serial_communication_node'), *arguments],
                                     stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
            try:
                def there(name=name):
                    try:
                        return self.master.lookupNode(name)
                    except rosgraph.MasterError:
                        return ''
                until(there, f'{name} is registered')
                again = subprocess.run([program('serial_communication_node'), *arguments],
                                       stderr=subprocess.PIPE, text=True, timeout=PATIENCE)
                self.assertEqual(again.returncode, TAKEN)
                self.assertIn(f'{name} is already running', again.stderr)
            finally:
                other.send_signal(signal.SIGINT)
                other.wait(PATIENCE)
        self.assert_unharmed()

    def test_a_killed_or_suspended_bridge_does_not_prevent_a_start(self):
        for number in signal.SIGKILL, signal.SIGSTOP:
            with self.subTest(number):
                old = self.bridge
                old.process.send_signal(number)
                if number == signal.SIGKILL:
                    old.process.wait(10)
                self.bridge = self.start()
                until(lambda: self.master.lookupNode(NAME) != self.address,
                      'the new one has the name')
                self.address = self.master.lookupNode(NAME)
                old.process.kill()
                old.process.wait(10)
                self.heartbeats = HeartbeatWatch(self.car, self.bridge.process.pid)
                self.car.wait_for_heartbeats(10)

    def test_another_node_at_a_dead_bridges_address_does_not_prevent_a_start(self):
        mine = rospy.get_node_uri()
        rosgraph.Master('/ghost').registerPublisher('/ghost/topic', 'std_msgs/Empty', mine)
        ghost = Bridge('ghost')
        self.started.append(ghost)
        until(lambda: self.master.lookupNode('/ghost') != mine, 'the new one has the name')

    def test_help_and_wrong_arguments_touch_neither_ros_nor_a_port(self):
        for arguments, status in ((['--help'], 0), (['-h'], 0), (['--wrong'], 2),
                                  (['/dev/ttyS0'], 2), ([':=x'], 2), (['bus'], 2)):
            with self.subTest(arguments):
                done = subprocess.run([program('serial_communication_node'), *arguments],
                                      stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                                      timeout=2 * PATIENCE)
                self.assertEqual(done.returncode, status)
                said, silent = (done.stderr, done.stdout) if status else (done.stdout,
                                                                          done.stderr)
                self.assertIn('usage: serial_communication_node ', said)
                self.assertEqual(silent, '')
                if status:
                    self.assertIn(repr(arguments[0]), lines_of(said)[0])
        self.assert_unharmed()


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

    def start(self, host='', meets=True, arguments=()):
        """Start a bridge on a host; with `meets`, it waits once it has found the name free."""
        settings = ['HOST=' + host] + ['MEETING=' + self.folder] * meets
        self.pair.append(Bridge('twin', {'bus/port': os.path.join(self.folder, 'bus')}, arguments,
                                before=['env', *settings, ELSEWHERE]))
        return self.pair[-1]

    def have_met(self):
        """How many bridges have found the name free."""
        return len(os.listdir(self.folder))

    def go(self):
        """Let the waiting bridges continue."""
        open(os.path.join(self.folder, 'go'), 'w').close()

    def owner(self):
        """The process id of the registered bridge, if it answers."""
        try:
            with ServerProxy(self.master.lookupNode('/twin'), _Impatient()) as node:
                return node.getPid('/same_name_test')[2]
        except (rosgraph.MasterError, OSError):
            return None

    def assert_one_lives(self):
        until(lambda: len([each for each in self.pair if each.alive]) == 1, 'one of them has ended',
              4 * PATIENCE)
        lives, = [each for each in self.pair if each.alive]
        ended, = [each for each in self.pair if not each.alive]
        said = lines_of(ended.output())
        self.assertEqual(ended.process.returncode, TAKEN, said)
        self.assertEqual([line for line in said if 'is already running' in line], said[-1:])
        until(lambda: self.owner() == lives.process.pid, 'the other one has the name',
              4 * PATIENCE)
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
            for turn in range(2):
                with self.subTest(hosts=hosts, turn=turn):
                    self.pair = []
                    for host in hosts:
                        self.start(host, meets=False)
                    self.assert_one_lives()

    def test_a_bridge_that_hangs_at_its_start_delays_another_by_10_s_at_most(self):
        hangs = self.start()
        until(lambda: self.have_met() == 1, 'the first one has found the name free')
        second = self.start(meets=False)
        until(lambda: self.owner() == second.process.pid, 'the second one has the name',
              2 * PATIENCE)
        self.assertTrue(hangs.alive)

    def test_a_displaced_bridge_starts_again_if_the_name_is_free(self):
        bridge = self.start(meets=False)
        until(lambda: self.owner() == bridge.process.pid, 'it has the name')
        rosgraph.Master('/twin').registerSubscriber('/any', 'std_msgs/Empty',
                                                    'http://localhost:1/')
        bridge.wait_for('another node has registered as /twin')
        until(lambda: self.owner() == bridge.process.pid, 'it has the name again', 2 * PATIENCE)

    def test_ctrl_c_ends_a_displaced_bridge(self):
        bridge = Bridge('twin')
        self.pair.append(bridge)
        until(lambda: self.owner() == bridge.process.pid, 'it has the name')
        rosgraph.Master('/twin').registerSubscriber('/any', 'std_msgs/Empty',
                                                    'http://localhost:1/')
        bridge.wait_for('another node has registered as /twin')
        _seconds, status = bridge.end(signal.SIGINT)
        self.assertEqual(status, 0, bridge.output())
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
            for number in signal.SIGINT, signal.SIGTERM:
                process = subprocess.Popen(
                    [program('serial_communication_node')], stderr=subprocess.PIPE, text=True,
                    env=dict(os.environ, ROS_MASTER_URI=uri))
                said = process.stderr.readline()
                self.assertIn(f'waiting for the ROS master at {uri}', said)
                self.assertIn('roscore', said)
                process.send_signal(number)
                rest = process.communicate(timeout=PATIENCE)[1]
                self.assertEqual((process.returncode, rest), (0, ''))


if __name__ == '__main__':
    rospy.init_node('same_name_test')
    rostest.rosrun(PACKAGE, 'same_name', '__main__')
