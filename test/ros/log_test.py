#!/usr/bin/python3
"""A bridge whose log cannot be written: its links work as usual."""
import os
import shutil
import subprocess
import unittest

import rospy
import rostest
from roscpp.srv import GetLoggers

from boards import (NOT_SENT, PACKAGE, PATIENCE, SPEED_0_PACKET, BoardsTest, Bridge, BusBoard,
                    CarBoard, Topic, own_folder, program, service, settle, until)
from serial_communication.msg import Voltage
from serial_communication.boards.arduino import wire as arduino
from serial_communication.srv import Lift


NOBODY = 65534


class Unwritable:
    """A bridge whose stdout and stderr cannot be written; the subclasses say why."""

    def setUp(self):
        super().setUp()
        self.bus, self.car = self.plug('bus', BusBoard), self.plug('arduino', CarBoard)
        self.descriptors = []
        self.bridge = self.start_bridge(stdout=self.output(), parameters={
            'bus/port': self.lines['bus'].near, 'arduino/port': self.lines['arduino'].near,
            'bus/motion_timeout': 0.5, 'bus/reply_timeout': 0.3, 'bus/environment_period': 0.0,
            'arduino/speed_timeout': 0.2})
        self.voltage = Topic('/serial_communication/voltage', Voltage)
        settle(PACKAGE, self.bus)
        self.assert_data_flows()
        self.spoil()

    def spoil(self):
        """Make the output unwritable, if it is not."""

    def tearDown(self):
        self.voltage.close()
        for descriptor in self.descriptors:
            os.close(descriptor)

    def assert_data_flows(self):
        """A measurement is published."""
        self.voltage.next(doing=lambda: self.car.say(arduino.Voltage(12.0)))

    def test_heartbeats_continue_and_the_bridge_ends_in_order(self):
        lift = service('/serial_communication/lift', Lift)
        for line in self.lines.values():
            line.unplug()
        until(lambda: lift(0, 1).status == NOT_SENT, 'the bridge has noticed')
        for line in self.lines.values():
            line.plug()
        until(lambda: self.car.connected and self.bus.connected, 'both boards are back')
        self.assert_data_flows()
        until(lambda: lift(0, 1).success, 'the lift answers')
        self.bus.write(bytes(1000))      # noise, which is logged
        self.car.forget()
        self.car.wait_for_heartbeats(100)
        self.assertEqual(self.bridge.end()[1], 0)
        until(lambda: self.car.raws[-1:] == [SPEED_0_PACKET], 'SPEED 0 is the last packet')


class ClosedPipe(Unwritable, BoardsTest):
    """The reader of the pipe has exited."""

    def output(self):
        self.descriptors += os.pipe()
        return self.descriptors[1]

    def spoil(self):
        os.close(self.descriptors.pop(0))


class FullPipe(Unwritable, BoardsTest):
    """The reader of the pipe does not read, like a terminal after Ctrl-S."""

    output = ClosedPipe.output

    def spoil(self):
        # Open it again, since O_NONBLOCK would otherwise apply to the bridge, too.
        writing = os.open('/proc/self/fd/%d' % self.descriptors[1], os.O_WRONLY | os.O_NONBLOCK)
        for size in 4096, 1:
            try:
                while True:
                    os.write(writing, bytes(size))
            except BlockingIOError:
                pass
        os.close(writing)


class FullDisk(Unwritable, BoardsTest):
    """A file on a full disk."""

    def output(self):
        self.descriptors.append(os.open('/dev/full', os.O_WRONLY))
        return self.descriptors[-1]


class NoLogFile(unittest.TestCase):
    """A bridge whose log file cannot be created: it runs, and prints where its log goes.

    If the test runs as root, the bridge is started without root's right to write everywhere.
    """

    def setUp(self):
        self.folder, self.temporary = own_folder(), own_folder()
        for folder in self.folder, self.temporary:
            self.addCleanup(shutil.rmtree, folder)
        self.home = os.path.join(self.folder, 'home')
        os.makedirs(os.path.join(self.home, 'log'))
        self.before = ['env', '-u', 'ROS_LOG_DIR', f'ROS_HOME={self.home}',
                       f'TMPDIR={self.temporary}']

    def lock(self, path):
        """Make a path unwritable for the bridge."""
        if os.getuid():
            os.chmod(path, 0o500)
            self.addCleanup(os.chmod, path, 0o700)
        else:
            os.chown(path, NOBODY, NOBODY)
            os.chmod(path, 0o755)
            self.before += [] if 'setpriv' in self.before else ['setpriv', '--bounding-set=-all']

    def start(self, *arguments):
        """Start the bridge; return its line about the log."""
        self.bridge = Bridge('no_log', arguments=arguments, before=self.before)
        self.addCleanup(self.bridge.end)
        service('/no_log/get_loggers', GetLoggers)()
        self.bridge.wait_for('no port is set')
        line = self.bridge.wait_for('the log cannot be written to ')
        self.assertNotIn('Traceback', self.bridge.output())
        self.assertEqual(self.bridge.output().count('the log cannot be written'), 1)
        self.assertNotIn('WARNING: ', self.bridge.output())
        return line

    def assert_in_a_new_folder(self, line, name):
        """The log is in the file that the line names."""
        folder, = os.listdir(self.temporary)
        path = os.path.join(self.temporary, folder, name)
        self.assertIn(f'it goes to {path}. ', line)
        self.assertEqual(os.stat(os.path.dirname(path)).st_mode & 0o777, 0o700)

        def written():
            with open(path) as log:
                return 'no port is set' in log.read()
        until(written, 'the log is written there')
        self.assertEqual(self.bridge.end()[1], 0)

    def test_the_log_file_belongs_to_another_user(self):
        path = os.path.join(self.home, 'log', 'no_log.log')
        open(path, 'w').close()
        self.lock(path)
        line = self.start()
        self.assertIn(f'the log cannot be written to {path} (Permission denied)', line)
        self.assert_in_a_new_folder(line, 'no_log.log')

    def test_a_log_file_named_by_roslaunch_cannot_be_created(self):
        run = os.path.join(self.home, 'log', 'run')
        os.mkdir(run)
        self.lock(run)
        line = self.start(f'__log:={run}/no_log-2.log')
        self.assert_in_a_new_folder(line, 'no_log-2.log')

    def test_ros_home_cannot_be_written(self):
        os.rmdir(os.path.join(self.home, 'log'))
        self.lock(self.home)
        self.assert_in_a_new_folder(self.start(), 'no_log.log')

    def test_the_disk_has_no_free_inode(self):
        mounts = ['unshare', '--mount', 'sh', '-c',
                  'mount -t tmpfs -o nr_inodes=1 tmpfs "$0" && exec "$@"', self.home]
        if subprocess.run(mounts + ['true'], stderr=subprocess.DEVNULL).returncode:
            self.skipTest('no file system can be mounted here: that takes root')
        self.before += mounts
        line = self.start()
        self.assertIn('(No space left on device)', line)
        self.assert_in_a_new_folder(line, 'no_log.log')

    def test_the_logging_configuration_is_wrong(self):
        mine = os.path.join(self.folder, 'python_logging.conf')
        with open(mine, 'w') as file:
            file.write('[loggers]\nkeys=none\n')
        self.before.append(f'ROS_PYTHON_LOG_CONFIG_FILE={mine}')
        line = self.start()
        self.assertIn('it goes to the terminal alone', line)
        self.assertEqual(self.bridge.end()[1], 0)

    def test_the_monitor_runs_without_a_log_file_too(self):
        self.lock(os.path.join(self.home, 'log'))
        done = subprocess.run(self.before + [program('monitor'), '--once', '--node', 'absent'],
                              stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                              timeout=PATIENCE)
        self.assertIn('monitor: no bridge /absent', done.stderr)
        self.assertIn('the log cannot be written to ', done.stderr)
        self.assertNotIn('Traceback', done.stderr)


if __name__ == '__main__':
    rospy.init_node('log_test')
    rostest.rosrun(PACKAGE, 'log', '__main__')
