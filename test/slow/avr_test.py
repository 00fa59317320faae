#!/usr/bin/python3
"""bridge.launch sim:=avr: the bridge with real firmware on emulated microcontrollers."""
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path
from xmlrpc.client import ServerProxy

import rosgraph
import rospy
import rostest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'ros'))
from boards import (NOT_SENT, Output, PACKAGE, PATIENCE, TIMEOUT, Topic,  # noqa: E402
                    again_if_stalled, command_topic, service, until, until_in_step, wait_for_launch)
from contract_published import PUBLISHED  # noqa: E402
from contract_robot import resolved  # noqa: E402
from serial_communication.msg import SpeedPWMCommand  # noqa: E402
from serial_communication.srv import Gimbal, Lift  # noqa: E402


class Launched(unittest.TestCase):
    """bridge.launch sim:=avr: all three boards, and a bridge that is started again."""

    NAMESPACE = '/launched'
    NODE = NAMESPACE + '/' + PACKAGE

    def setUp(self):
        self.folder = tempfile.mkdtemp(prefix='rostest_')
        self.addCleanup(shutil.rmtree, self.folder, ignore_errors=True)
        self.output = Output()
        self.addCleanup(self.output.close)
        self.process = subprocess.Popen(
            ['roslaunch', PACKAGE, 'bridge.launch', 'sim:=avr', 'sim_dir:=' + self.folder],
            env=dict(os.environ, ROS_NAMESPACE=self.NAMESPACE), stdout=self.output,
            stderr=subprocess.STDOUT)
        self.addCleanup(self.end)

    def end(self):
        """Send Ctrl-C; return the output and the exit status."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        status = self.process.wait(PATIENCE)
        return self.output.text(), status

    def ask(self, link, line):
        """Send a line to the control channel of a link's board; return the answer."""
        with socket.socket(socket.AF_UNIX) as control:
            control.settimeout(PATIENCE)
            control.connect(os.path.join(self.folder, link + '.control'))
            control.sendall(line.encode() + b'\n')
            return control.makefile().readline().strip()

    def get(self, link, name):
        return float(self.ask(link, 'get ' + name))

    def assert_moves(self, position, units, call, *arguments):
        """A call succeeds and moves an axis; again if the machine stalled."""
        def moved():
            until_in_step(self.NODE[1:])
            before, answer = self.get('bus', position), call(*arguments)
            if answer.status in (NOT_SENT, TIMEOUT):
                return False
            self.assertTrue(answer.success, answer.message)
            self.assertAlmostEqual(self.get('bus', position) - before, units, 6)
            return True
        again_if_stalled(moved)

    def bridge_pid(self):
        """The process id of the bridge; 0 if it does not answer."""
        try:
            uri = rosgraph.Master('/avr_test').lookupNode(self.NODE)
            return ServerProxy(uri).getPid('/avr_test')[2]
        except (OSError, rosgraph.MasterException):
            return 0

    def test_all_boards_work_and_a_bridge_that_is_killed_returns_with_the_motor_off(self):
        wait_for_launch(self.NODE[1:])
        for name, message_class in [item for link in ('bus', 'arduino', 'mcu')
                                    for item in PUBLISHED[link].items()]:
            if name == 'mcu/adc_status':
                continue
            topic = Topic(self.NAMESPACE + resolved(name), message_class)
            self.addCleanup(topic.close)
            topic.first()
        self.assert_moves('lift_position', 4, service(self.NODE + '/lift', Lift), 0, 4)
        self.assert_moves('pan_position', -3, service(self.NODE + '/gimbal', Gimbal), 1, 3)

        def drive():
            speed = command_topic(self.NODE + '/speed', SpeedPWMCommand)
            until(lambda: self.get('arduino', 'motor_pwm') == 128, 'the motor runs',
                  doing=lambda: speed.publish(value=500))
            speed.unregister()
        drive()
        pid = until(self.bridge_pid, 'the bridge answers')
        os.kill(pid, signal.SIGKILL)
        until(lambda: self.get('arduino', 'motor_pwm') == 0, 'the motor stops')
        changes = self.ask('arduino', 'history motor_pwm')
        until(lambda: self.bridge_pid() not in (0, pid), 'roslaunch starts the bridge again',
              every=0.1)
        received = self.get('arduino', 'rx_bytes')
        until(lambda: self.get('arduino', 'rx_bytes') > received + 200, 'heartbeats come again')
        self.assertEqual(self.ask('arduino', 'history motor_pwm'), changes)
        drive()
        text, status = self.end()
        self.assertEqual(status, 0, text)
        self.assertNotIn('escalating', text)
        self.assertNotIn('Traceback', text)
        self.assertEqual([name for name in os.listdir(self.folder) if not name.endswith('.eeprom')],
                         [], 'what the boards leave behind')


if __name__ == '__main__':
    rospy.init_node('avr_test')
    rostest.rosrun(PACKAGE, 'avr', '__main__')
