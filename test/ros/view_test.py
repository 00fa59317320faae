#!/usr/bin/python3
"""view.launch: rviz starts with the configuration, and none of its displays has an error."""
import os
import shutil
import signal
import subprocess
import tempfile
import unittest
from pathlib import Path

import rosgraph
import rospy
import rostest
from tf2_msgs.msg import TFMessage

from boards import PACKAGE, PATIENCE, Topic, until

HERE = Path(__file__).resolve().parent
CONFIG = HERE.parents[1] / 'config' / 'view.rviz'

# Debian's rviz sometimes damages its memory at its start, with a software renderer: it ends with
# SIGSEGV, or with SIGABRT where malloc finds the damage.
CRASHES = signal.SIGSEGV.value, signal.SIGABRT.value


class View(unittest.TestCase):
    """roslaunch with a virtual display."""

    def setUp(self):
        self.folder = Path(tempfile.mkdtemp(prefix='rostest_'))
        reading, writing = os.pipe()
        self.display = subprocess.Popen(
            ['Xvfb', '-displayfd', str(writing), '-screen', '0', '1280x800x24', '-nolisten', 'tcp'],
            pass_fds=[writing], stderr=subprocess.DEVNULL)
        os.close(writing)
        with os.fdopen(reading) as number:
            self.environment = {**os.environ, 'DISPLAY': f':{number.readline().strip()}'}
        self.log = open(self.folder / 'log', 'a+')
        # A low frame rate, since the processor renders.
        self.config = self.configuration('view.rviz', 'Frame Rate: 30', 'Frame Rate: 3')
        self.launch = self.start()

    def start(self):
        """Start view.launch, with an empty log."""
        self.log.truncate(0)
        return subprocess.Popen(
            ['roslaunch', PACKAGE, 'view.launch', 'sim:=true', f'rviz_config:={self.config}'],
            stdout=self.log, stderr=subprocess.STDOUT, env=self.environment)

    def tearDown(self):
        for process in self.launch, self.display:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
                process.wait(PATIENCE)
        self.log.close()
        shutil.rmtree(self.folder)

    def configuration(self, name, words, others):
        """Write a copy of the configuration with replacements; return its path."""
        text = CONFIG.read_text()
        self.assertIn(words, text)
        (self.folder / name).write_text(text.replace(words, others))
        return self.folder / name

    def start_again(self):
        """Start view.launch again if rviz has crashed, and return whether it has."""
        if self.launch.poll() is None:
            return False
        self.log.seek(0)
        died = r'process \[rviz-\d+\] has died!\s+process has died \[pid \d+, exit code -'
        self.assertRegex(self.log.read(), rf'{died}({"|".join(map(str, CRASHES))}),')
        self.launch = self.start()
        return True

    def statuses(self, config, seconds):
        """Whether no display has a problem within this time, and the statuses."""
        for _ in range(3):
            done = subprocess.run(['/usr/bin/python3', str(HERE / 'rviz_statuses.py'), str(config),
                                   str(seconds)], env=self.environment, timeout=seconds + PATIENCE,
                                  stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
            if -done.returncode not in CRASHES:
                break
        return done.returncode, done.stdout

    def test_no_display_has_an_error(self):
        master = rosgraph.Master('/view_test')

        def shown():
            return {name for name, nodes in master.getSystemState()[1] if '/rviz' in nodes}
        until(lambda: {'/mcu/range_1', '/mcu/range_2', '/tf', '/tf_static'} <= shown(),
              'rviz subscribes', PATIENCE, doing=self.start_again)
        status, said = self.statuses(self.config, PATIENCE)
        if self.start_again():
            status, said = self.statuses(self.config, PATIENCE)
        self.assertEqual(status, 0, said)
        for display in 'Ground', 'Car', 'Attitude', 'Frames', 'Range 1', 'Range 2':
            self.assertIn(f'{display}: Status: Ok', said)
        self.assertIn('Attitude: imu_orientation: Transform OK', said)
        self.assertRegex(said, r'Range 1: Topic: \d+ messages received')
        # Only the bridge publishes the bridge's frames.
        model = Topic('/tf_static', TFMessage)
        until(lambda: any('wheel_front_left' == each.child_frame_id for message in model.messages
                          for each in message.transforms), 'the model has its frames')
        by_node = {}
        for message in model.messages:
            for each in message.transforms:
                by_node.setdefault(message._connection_header['callerid'], set()).add(
                    each.child_frame_id)
        self.assertEqual({name[:5] for name in by_node['/car_model']}, {'wheel'})

        # This test does report an error if there is one.
        status, said = self.statuses(self.configuration(
            'bad.rviz', 'Fixed Frame: base_link', 'Fixed Frame: nowhere'), 5.0)
        self.assertEqual(status, 1, said)
        self.assertIn('Car: Status: Error', said)

        self.launch.send_signal(signal.SIGINT)
        self.assertEqual(self.launch.wait(PATIENCE), 0)
        self.log.seek(0)
        log = self.log.read()
        self.assertNotIn('Traceback', log)
        self.assertNotIn('[ERROR]', log)


if __name__ == '__main__':
    rospy.init_node('view_test')
    rostest.rosrun(PACKAGE, 'view', '__main__')
