#!/usr/bin/python3
"""Parameters: a wrong one ends the node with one line; every link works without the others."""
import re
import signal
import subprocess
import unittest
from multiprocessing.pool import ThreadPool

import rosgraph
import rospy
import rostest

from boards import PACKAGE, PATIENCE, Bridge, until
from parameter_table_test import (ExternalBoards, Lines,  # noqa: F401
                                  ParameterTable)

# Parameter, value, and what the line says that it may be; one of each kind. parameter_table_test
# checks every parameter, without processes.
WRONG = (
    ('frame_timeout', 'soon', 'a number from 0.001 to 10 (s)'),
    ('bus/port', 'socket://robot', 'takes a host, a port and options'),
    ('arduino', 'off', 'a group of parameters'),
)


def start_and_read(number, parameters):
    """Status and output of a bridge with these parameters, which ends by itself."""
    bridge = Bridge('wrong_%d' % number, parameters)
    try:
        return bridge.process.wait(PATIENCE), bridge.output()
    except subprocess.TimeoutExpired:
        return 'it goes on', bridge.output()
    finally:
        bridge.kill()


class WrongParameters(unittest.TestCase):
    """Parameters that end the node at the start."""

    def test_each_ends_the_node_with_a_line_that_has_its_name_its_value_and_what_it_may_be(self):
        with ThreadPool(2) as pool:
            results = pool.starmap(start_and_read, [(number, {name: value}) for number, (
                name, value, _) in enumerate(WRONG)])
        for number, ((name, value, allowed), (status, output)) in enumerate(zip(WRONG, results)):
            line, = [line for line in output.split('\n') if line.strip()]
            for words in f'parameter /wrong_{number}/{name} is {value!r}', allowed, 'FATAL':
                self.assertIn(words, line)
            self.assertEqual(status, 1)


class Names(unittest.TestCase):
    """Links that are on or off, and unknown parameters."""

    TOPICS = {
        'bus': {'~environment', '~environment/temperature', '~environment/humidity'},
        'arduino': {'~imu', '~imu/temperature', '~imu/calibrating', '~voltage', '~ticks',
                    '~steering_angle'},
        'mcu': {'mcu/status', 'mcu/adc_status', 'mcu/imu', 'mcu/range_1', 'mcu/range_2'},
    }
    SUBSCRIBED = {'bus': set(), 'arduino': {'~speed', '~steering', '~led'}, 'mcu': set()}
    SERVICES = {
        'bus': {'~lift', '~gimbal', '~get_environment', '~bus/request', '~bus/echo',
                '~bus/sync'},
        'arduino': {'~calibrate_imu'}, 'mcu': set(),
    }
    OF_ROS = {'/rosout', '/tf', '/tf_static', '/clock', '/statistics'}

    def setUp(self):
        self.bridge = None

    def tearDown(self):
        self.bridge.kill()

    def start(self, *links, **parameters):
        """Start a bridge with these links, whose ports are absent."""
        given = {link + '/port': '/tmp/rostest_absent/' + link for link in links}
        given.update((name.replace('__', '/'), value) for name, value in parameters.items())
        self.bridge = Bridge('bridge', given)
        until(lambda: '/serial_msg' in self.seen()[0] or not self.bridge.alive,
              'the bridge is up')
        self.assertTrue(self.bridge.alive, self.bridge.output())

    @staticmethod
    def seen():
        """The bridge's topics, subscriptions and services."""
        state = rosgraph.Master('/parameters_test').getSystemState()
        return [{name for name, nodes in entries if '/bridge' in nodes} for entries in state]

    def expected(self, links, table):
        return {'/bridge/' + name[1:] if name[0] == '~' else '/' + name
                for link in links for name in table[link]}

    def assert_interface(self, *links):
        """The bridge has exactly the topics and services of these links, and those of any node."""
        services = self.expected(links, self.SERVICES) | {
            '/bridge/%s/%s' % (link, name) for link in links for name in ('release', 'reset')} | {
            '/bridge/stop'}
        until(lambda: self.seen()[2] >= services and (
            '/diagnostics' in self.seen()[0] or not links), 'services of %s' % (links,))
        published, subscribed, served = self.seen()
        self.assertEqual(published - self.OF_ROS - {'/diagnostics'},
                         self.expected(links, self.TOPICS) | {'/serial_msg'})
        self.assertEqual(subscribed - self.OF_ROS, self.expected(links, self.SUBSCRIBED))
        self.assertEqual({name for name in served if not re.search('logger', name)}, services)

    def assert_ends(self):
        _seconds, status = self.bridge.end(signal.SIGINT)
        self.assertEqual(status, 0, self.bridge.output())

    def test_each_link_works_alone(self):
        for link in self.TOPICS:
            self.start(link)
            self.bridge.wait_for('off, because no port is set: ' + ', '.join(
                other for other in self.TOPICS if other != link))
            self.assert_interface(link)
            self.assert_ends()

    def test_without_any_port_the_node_runs_and_warns(self):
        self.start()
        self.assertIn('WARN', self.bridge.wait_for('no port is set'))
        self.assert_interface()
        self.assertTrue(self.bridge.alive)
        self.assert_ends()


if __name__ == '__main__':
    rospy.init_node('parameters_test')
    rostest.rosrun(PACKAGE, 'parameters', '__main__')
