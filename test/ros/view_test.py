#!/usr/bin/python3
"""view.launch: rviz starts with the configuration and shows the bridge's topics in known frames."""
import os
import signal
import subprocess
import unittest

import rosgraph
import rospy
import rostest
import tf2_ros
from sensor_msgs.msg import Range

from boards import PACKAGE, Process, Topic, until

# Debian's rviz sometimes damages its memory at its start, with a software renderer: it ends with
# SIGSEGV, or with SIGABRT where malloc finds the damage.
CRASHES = signal.SIGSEGV, signal.SIGABRT
SHOWN = {'/mcu/range_1', '/mcu/range_2', '/tf', '/tf_static'}
FRAMES = 'imu_orientation', 'mcu_imu_orientation', 'range_1', 'range_2', 'wheel_front_left'


class View(unittest.TestCase):
    """roslaunch with a virtual display."""

    def setUp(self):
        reading, writing = os.pipe()
        display = subprocess.Popen(
            ['Xvfb', '-displayfd', str(writing), '-screen', '0', '1280x800x24', '-nolisten', 'tcp'],
            pass_fds=[writing], stderr=subprocess.DEVNULL)
        self.addCleanup(display.wait)
        self.addCleanup(display.terminate)
        os.close(writing)
        with os.fdopen(reading) as number:
            self.display = f':{number.readline().strip()}'
        self.launch = self.start()
        self.addCleanup(lambda: self.launch.alive and self.launch.end())

    def start(self):
        """Start view.launch."""
        return Process('roslaunch', PACKAGE, 'view.launch', 'sim:=true', DISPLAY=self.display)

    def start_again(self):
        """Start view.launch again if rviz has crashed."""
        if not self.launch.alive:
            said = self.launch.output()
            self.assertTrue(any(f'exit code -{each.value},' in said for each in CRASHES), said)
            self.launch = self.start()

    def test_rviz_shows_the_bridge_in_known_frames(self):
        def shown():
            state = rosgraph.Master('/view_test').getSystemState()[1]
            return {name for name, nodes in state if '/rviz' in nodes} >= SHOWN
        until(shown, 'rviz subscribes', doing=self.start_again, every=0.1)
        frames = tf2_ros.Buffer()
        self.addCleanup(tf2_ros.TransformListener(frames).unregister)
        for frame in FRAMES:
            until(lambda f=frame: frames.can_transform('base_link', f, rospy.Time()), frame)
        Topic('/mcu/range_1', Range).first()
        self.start_again()
        self.assertEqual(self.launch.end(), 0)
        # Icons need a plugin that Debian 13's rviz does not bring.
        said = [line for line in self.launch.output().splitlines() if ' pixmap ' not in line]
        for words in 'Traceback', '[ERROR]':
            self.assertNotIn(words, '\n'.join(said))


if __name__ == '__main__':
    rospy.init_node('view_test')
    rostest.rosrun(PACKAGE, 'view', '__main__')
