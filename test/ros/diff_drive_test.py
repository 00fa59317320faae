#!/usr/bin/python3
"""diff_drive.launch with the example DiffDrive in a base with two wheels that have mass."""
import math
import os
import signal
import subprocess
import unittest
from xmlrpc.client import ServerProxy

import rosgraph
import rospy
import rostest
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry

from avr_boards import ANNOUNCED, EmulatedBoard, build_firmware, transforms_with
from boards import Output, PACKAGE, PATIENCE, Topic, until
from serial_communication.framing.rotation import angles

EVERY = 0.05     # s between two commands, as teleop_twist_keyboard with a key held


class DiffDriveTest(unittest.TestCase):
    """Drives by /cmd_vel."""

    @classmethod
    def setUpClass(cls):
        cls.board = EmulatedBoard(build_firmware(), 'diff')
        cls.addClassCleanup(cls.board.close)
        cls.output = Output()
        cls.launched = subprocess.Popen(
            ['roslaunch', PACKAGE, 'diff_drive.launch', 'port:=' + cls.board.port],
            stdout=cls.output, stderr=subprocess.STDOUT)
        cls.addClassCleanup(cls.end)
        cls.odometry = Topic('/odom', Odometry, wait=False)
        cls.commands = rospy.Publisher('/cmd_vel', Twist, queue_size=1)
        end = cls.board.time + 2 * ANNOUNCED
        until(lambda: cls.commands.get_num_connections() and cls.odometry.publishers
              or cls.board.time > end, 'the base announces', seconds=4 * ANNOUNCED)
        cls.odometry.first()

    @classmethod
    def end(cls):
        cls.launched.send_signal(signal.SIGINT)
        cls.launched.wait(PATIENCE)
        text = cls.output.text()
        cls.output.close()
        assert 'Traceback' not in text, text

    def drive(self, ahead, turn=0.0):
        command = Twist()
        command.linear.x, command.angular.z = ahead, turn
        self.commands.publish(command)

    def drive_until(self, condition, what, ahead, turn=0.0):
        """Publish a command until a condition holds."""
        return until(condition, what, every=EVERY, doing=lambda: self.drive(ahead, turn))

    def latest(self):
        """The latest odometry."""
        return self.odometry.messages[-1]

    def is_at(self, ahead, turn):
        """Whether the base has these speeds, and the odometry says so."""
        left, right = self.board.get('left_speed'), self.board.get('right_speed')
        told = self.latest().twist.twist
        return abs((left + right) / 2 - ahead) < 0.02 and abs((right - left) / 0.16 - turn) < 0.2 \
            and abs(told.linear.x - ahead) < 0.03 and abs(told.angular.z - turn) < 0.3

    def stands(self):
        """Whether it stands, and the odometry says so."""
        told = self.latest().twist.twist
        return max(abs(self.board.get('left_speed')), abs(self.board.get('right_speed'))) < 1e-4 \
            and (told.linear.x, told.angular.z) == (0, 0)

    def test_cmd_vel_drives_and_odom_has_where_the_base_is(self):
        transforms = transforms_with(self, 'odom', 'base_link')
        for ahead, turn in (0.3, 0.0), (0.0, 1.5), (0.2, -0.8), (-0.2, 0.0):
            self.drive_until(lambda a=ahead, t=turn: self.is_at(a, t),
                             f'it drives at {ahead}, {turn}', ahead, turn)
        self.drive_until(self.stands, 'it stands', 0.0)
        begin = rospy.Time.now()
        until(lambda: self.latest().header.stamp > begin, 'odometry of the base at rest')
        message = self.latest()
        self.assertEqual((message.header.frame_id, message.child_frame_id), ('odom', 'base_link'))
        self.assertLess((rospy.Time.now() - message.header.stamp).to_sec(), PATIENCE)
        self.assertEqual([message.pose.covariance[index] for index in (0, 7, 14, 35)],
                         [0.01, 0.01, 1e6, 0.03])
        at, turned = message.pose.pose.position, message.pose.pose.orientation
        off = math.hypot(at.x - self.board.get('x'), at.y - self.board.get('y'))
        yaw = angles(turned.x, turned.y, turned.z, turned.w)[2]
        apart = math.remainder(yaw - math.radians(self.board.get('yaw')), 2 * math.pi)
        self.assertLess(off, 0.005, 'm')
        self.assertLess(abs(apart), 0.01, 'rad')
        self.assertGreater(math.hypot(at.x, at.y), 0.01, 'it has moved')
        found = until(lambda: transforms.can_transform('odom', 'base_link', message.header.stamp)
                      and transforms.lookup_transform('odom', 'base_link', message.header.stamp),
                      'tf has it')
        self.assertAlmostEqual(found.transform.translation.x, at.x, 9)
        self.assertAlmostEqual(found.transform.rotation.z, turned.z, 6)

    def test_a_setting_of_dynparam_is_used_by_the_sketch(self):
        def limit(speed):
            subprocess.check_call(['rosrun', 'dynamic_reconfigure', 'dynparam', 'set',
                                   f'/{PACKAGE}/settings/arduino', 'max_speed', str(speed)])

        self.addCleanup(limit, 0.5)
        self.drive_until(lambda: self.is_at(0.3, 0.0), 'it drives', 0.3)
        limit(0.1)
        self.drive_until(lambda: self.is_at(0.1, 0.0), 'it drives at its new limit', 0.3)

    def test_the_wheels_stop_when_the_publisher_stops(self):
        self.drive_until(lambda: self.is_at(0.3, 0.0), 'it drives', 0.3)
        until(self.stands, 'it stands')
        for wheel in 'left', 'right':
            self.assertEqual(self.board.get(wheel + '_pwm'), 0)

    def test_the_wheels_stop_when_the_bridge_is_suspended(self):
        """No heartbeat comes; a command that waits drives nothing afterwards."""
        self.drive_until(lambda: self.is_at(0.3, 0.0), 'it drives', 0.3)
        master = rosgraph.Master('/diff_drive_test')
        pid = ServerProxy(master.lookupNode('/' + PACKAGE)).getPid('/diff_drive_test')[2]
        os.kill(pid, signal.SIGSTOP)
        try:
            self.drive(0.3)
            until(lambda: self.board.time - self.board.get('last_rx_time') > 0.1, 'silence')
            off = [self.board.history(wheel + '_pwm')[-1] for wheel in ('left', 'right')]
            last = self.board.get('last_rx_time')
        finally:
            os.kill(pid, signal.SIGCONT)
        for when, duty in off:
            self.assertEqual(duty, 0)
            self.assertLess(when - last, 0.033)
        until(self.stands, 'it stands')


if __name__ == '__main__':
    rospy.init_node('diff_drive_test')
    rostest.rosrun(PACKAGE, 'diff_drive', '__main__')
