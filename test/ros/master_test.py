#!/usr/bin/python3
"""The master ends, is replaced by a new one, or hangs, while a bridge is running."""
import os
import signal
import socket
import subprocess

import rosgraph
import rostest

from boards import PACKAGE, PATIENCE, BoardsTest, BusBoard, CarBoard, until
from heartbeats import HeartbeatWatch
from serial_communication.boards.arduino import wire as arduino
from serial_communication.framing.announcement import chunks_of

NAME = '/' + PACKAGE
WITHIN = 10.0         # s in which the bridge must register at a new master
MOUNT = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0]


def free_port():
    """A TCP port of this host that is not in use."""
    with socket.socket() as listener:
        listener.bind(('127.0.0.1', 0))
        return listener.getsockname()[1]


def answer_of(call, *arguments):
    """Return the answer of a call of the master; None for an error."""
    try:
        return call(*arguments)
    except (rosgraph.MasterException, OSError):
        return None


def state(server, node):
    """Return a node's topics, subscriptions and services."""
    return [{name for name, nodes in entries if node in nodes}
            for entries in server.getSystemState()]


def start_core(uri):
    """Start a roscore and return its process."""
    core = subprocess.Popen(['roscore', '-p', uri.rsplit(':', 1)[1]],
                            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    server = rosgraph.Master('/master_test', uri)
    until(server.is_online, 'the master answers', every=0.1)
    # Until then, Ctrl-C may miss the node that it is starting, and then takes 15 s.
    until(lambda: answer_of(server.lookupNode, '/rosout'), 'roscore is complete')
    return core


def stop_core(core):
    """Send Ctrl-C, and wait until the master has ended."""
    core.send_signal(signal.SIGINT)
    core.wait(PATIENCE)


class Tool:
    """A command line tool of ROS that uses the master at `uri`."""

    def __init__(self, uri, *command):
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE,
                                         stderr=subprocess.STDOUT, text=True,
                                         env=dict(os.environ, ROS_MASTER_URI=uri))

    def output(self):
        """Wait until the tool ends by itself; return its output."""
        return self._process.communicate(timeout=2 * PATIENCE)[0]

    def close(self):
        """End it."""
        self._process.kill()
        self._process.communicate()


class MasterTest(BoardsTest):
    """A bridge with two boards, and a roscore that the tests restart."""

    def setUp(self):
        super().setUp()
        self.bus, self.car = self.plug('bus', BusBoard), self.plug('arduino', CarBoard)
        self.uri = 'http://localhost:%d' % free_port()
        self.server = rosgraph.Master('/master_test', self.uri)
        self.core = None
        self.start_core()
        self.addCleanup(self.stop_core)
        self.bridge = self.start_bridge(master=self.uri, parameters={
            'bus/port': self.lines['bus'].near, 'bus/environment_period': 0.2,
            'arduino/port': self.lines['arduino'].near, 'arduino/speed_timeout': 0.0,
            'arduino/imu_mount': MOUNT})
        until(lambda: self.known(), 'the bridge is up')
        self.before = self.state()
        self.car.wait_for_heartbeats(1)

    def start_core(self):
        """Start a roscore, always at the same port."""
        self.core = start_core(self.uri)

    def stop_core(self):
        """Send Ctrl-C, and wait until the master has ended."""
        stop_core(self.core)

    def state(self):
        """The bridge's topics, subscriptions and services."""
        return state(self.server, NAME)

    def known(self):
        """Whether the last of its services is registered."""
        state = answer_of(self.state)
        return state and NAME + '/calibrate_imu' in state[2] and '/diagnostics' in state[0]

    def call(self, name, *arguments):
        """Return the output of `rosservice call`."""
        return Tool(self.uri, 'rosservice', 'call', NAME + '/' + name, *arguments).output()

    def assert_a_fresh_subscriber_gets_data(self):
        """`rostopic echo`, which asks the master, receives data."""
        tool = Tool(self.uri, 'rostopic', 'echo', '-n', '1', NAME + '/voltage/value')
        try:
            until(lambda: tool._process.poll() is not None, 'rostopic gets a message',
                  2 * PATIENCE, doing=lambda: self.car.say(arduino.Voltage(12.0)), every=0.1)
            self.assertIn('12.0', tool.output())
        finally:
            tool.close()

    def watch_heartbeats(self):
        """Watch the heartbeats from now on."""
        return HeartbeatWatch(self.car, self.bridge.process.pid)

    def test_topics_services_and_parameters_are_registered_at_a_new_master(self):
        text = b'force: {type: 32, ros_type: std_msgs/Float32, layout: "<h", fields: [data]}'
        until(lambda: NAME + '/force' in self.state()[0], 'the announced row is in use',
              doing=lambda: [self.car.say(chunk) for chunk in chunks_of(text, 50)])
        self.before = self.state()
        for turn in range(2):
            heartbeats = self.watch_heartbeats()
            self.stop_core()
            self.start_core()
            until(lambda: self.state() == self.before and self.server.hasParam(NAME),
                  'turn %d: all is there again' % turn, WITHIN)
        self.assertEqual(self.server.getParam(NAME + '/arduino/imu_mount'), MOUNT)
        self.assertEqual(self.server.getParam(NAME + '/arduino/announced/force/type'), 32)
        self.assertEqual(self.server.getParam(NAME + '/bus/port'), self.lines['bus'].near)
        self.assert_a_fresh_subscriber_gets_data()
        self.assertIn('success: True', self.call('lift', '{direction: 0, distance: 100}'))
        publisher = Tool(self.uri, 'rostopic', 'pub', '-r', '10', NAME + '/speed',
                         PACKAGE + '/SpeedPWMCommand', '{value: 321}')
        try:
            until(lambda: 321 in self.car.speeds, 'a new publisher reaches the bridge')
        finally:
            publisher.close()
        heartbeats.check()
        output = self.bridge.output()
        self.assertEqual(output.count('is a new ROS master'), 2, output)
        self.assertEqual(output.count('lost'), 0, output)
        self.assertEqual(self.car.bad, [])

    def test_parameters_that_a_new_master_already_has_are_kept(self):
        self.stop_core()
        self.start_core()
        self.server.setParam(NAME + '/bus/retries', 7)
        until(lambda: self.known(), 'all is there again', WITHIN)
        self.assertEqual(self.server.getParam(NAME + '/bus/retries'), 7)
        self.assertEqual(self.server.getParam(NAME + '/bus/port'), self.lines['bus'].near)

    def test_connected_nodes_stay_connected_without_a_master(self):
        echo = Tool(self.uri, 'rostopic', 'echo', '-n', '2', NAME + '/voltage/value')
        publisher = Tool(self.uri, 'rostopic', 'pub', '-r', '10', NAME + '/speed',
                         PACKAGE + '/SpeedPWMCommand', '{value: 321}')
        try:
            until(lambda: 321 in self.car.speeds, 'the car drives')
            until(lambda: any(name == NAME + '/voltage' and nodes for name, nodes
                              in self.server.getSystemState()[1]), 'rostopic subscribes')
            self.stop_core()
            self.bridge.wait_for('no answer from the ROS master')
            heartbeats = self.watch_heartbeats()
            until(lambda: len(self.car.speeds) >= 5, 'the commands go on')
            until(lambda: echo._process.poll() is not None, 'the subscriber still gets messages',
                  doing=lambda: self.car.say(arduino.Voltage(12.0)), every=0.1)
            heartbeats.check()
        finally:
            publisher.close()
            echo.close()

    def test_a_master_that_hangs_delays_nothing(self):
        self.core.send_signal(signal.SIGINT)
        self.core.wait(PATIENCE)
        with socket.socket() as hung:
            hung.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            hung.bind(('', int(self.uri.rsplit(':', 1)[1])))
            hung.listen(64)
            heartbeats = self.watch_heartbeats()
            self.bridge.wait_for('no answer from the ROS master')
            self.lines['bus'].unplug()       # this is logged, also to /rosout
            self.lines['bus'].plug()
            self.bridge.wait_for('opening it again')
            self.bus.forget()
            until(lambda: self.bus.others, 'the bus is polled again')
            self.car.wait_for_heartbeats(100)
            heartbeats.check()
            seconds, status = self.bridge.end()
            self.assertEqual(status, 0, self.bridge.output())
            self.assertLess(seconds, 2.5)
        self.start_core()


if __name__ == '__main__':
    rostest.rosrun(PACKAGE, 'master', '__main__')
