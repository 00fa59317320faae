#!/usr/bin/python3
"""The master of a bridge that runs ends, and a new one takes its place: the bridge starts again
there."""
import os
import subprocess

import rosgraph
import rostest

from boards import PACKAGE, PATIENCE, SPEED_0_PACKET, BoardsTest, CarBoard, until
from serial_communication.simulation.announcing import chunks_of

NAME = '/' + PACKAGE
WITHIN = 10.0         # s in which the bridge must be back at a new master
ROWS = (b'force: {type: 32, ros_type: std_msgs/Float32, layout: "<h", fields: [data]}\n'
        b'kp: {setting: 1, layout: "<f"}')


class MasterTest(BoardsTest):
    """A car, and a master beside rostest's."""

    def setUp(self):
        super().setUp()
        self.car = self.plug('arduino', CarBoard)
        self.master = self.start_master()
        self.server = self.master.server
        self.bridge = None

    def start(self, **parameters):
        self.bridge = self.start_bridge(master=self.master.uri, parameters={
            'arduino/port': self.lines['arduino'].near, 'arduino/network_silence': 0.0,
            **{name.replace('__', '/'): value for name, value in parameters.items()}})
        until(self.is_up, 'the bridge is up')

    def names(self):
        """The bridge's topics, subscriptions and services; none if the master does not answer."""
        try:
            return [{name for name, nodes in entries if NAME in nodes}
                    for entries in self.server.getSystemState()]
        except (rosgraph.MasterException, OSError):
            return [set()] * 3

    def is_up(self):
        """Whether the last of the bridge's services is registered."""
        return NAME + '/arduino/reset' in self.names()[2]

    def announce(self):
        """Announce the rows."""
        for chunk in chunks_of(ROWS, 50):
            self.car.say(chunk)

    def replace_master(self):
        self.master.end()
        self.master.start()

    def test_a_new_master_gets_all_names_and_parameters_and_speed_0_goes_out_first(self):
        self.start(arduino__speed_timeout=0.7, settings__arduino__kp=2.0)
        until(lambda: NAME + '/force' in self.names()[0]
              and NAME + '/settings/arduino/set_parameters' in self.names()[2],
              'the rows are in use', doing=self.announce, every=0.2)
        before, pid = self.names(), self.bridge.process.pid
        self.master.end()
        self.car.forget()
        self.car.wait_for_heartbeats(100)       # a master that is gone changes nothing
        self.assertEqual(self.car.speeds, [])
        self.master.start()
        until(self.is_up, 'the bridge is back', WITHIN)
        self.assertIn(SPEED_0_PACKET, self.car.raws)
        until(lambda: self.names() == before, 'the rows are back', doing=self.announce, every=0.2)
        for key, value in (('arduino/port', self.lines['arduino'].near),
                           ('arduino/speed_timeout', 0.7), ('settings/arduino/kp', 2.0),
                           ('arduino/announced/force/type', 32)):
            until(lambda: self.server.hasParam(f'{NAME}/{key}'), f'{key} is set')
            self.assertEqual(self.server.getParam(f'{NAME}/{key}'), value)
        self.assertEqual(self.bridge.output().count('is a new ROS master'), 1)
        self.assertEqual(self.bridge.process.pid, pid)
        self.assertEqual(self.bridge.end()[1], 0, self.bridge.output())
        self.assertNotIn('Traceback', self.bridge.output())

    def call(self, service, request):
        """A rosservice process that calls a service of the bridge."""
        process = subprocess.Popen(
            ['rosservice', 'call', f'{NAME}/{service}', request],
            env=dict(os.environ, ROS_MASTER_URI=self.master.uri), text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        self.addCleanup(process.kill)
        return process

    def test_a_stop_that_held_holds_at_the_new_master(self):
        self.start()
        stop = self.call('stop', 'data: true').communicate(timeout=PATIENCE)[0]
        self.assertIn('success: True', stop)
        self.replace_master()
        self.bridge.wait_for('is a new ROS master')
        until(self.is_up, 'the bridge is back', WITHIN)
        refused = self.call('calibrate_imu', '{}').communicate(timeout=PATIENCE)[0]
        self.assertIn('stopped: call ~stop with data: false', refused)


if __name__ == '__main__':
    rostest.rosrun(PACKAGE, 'master', '__main__')
