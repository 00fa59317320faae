#!/usr/bin/python3
"""Follows doc/tuning.md: the example Tuning on an emulated board, tuned by dynamic_reconfigure."""
import itertools
import os
import re
import shutil
import signal
import socket
import subprocess
import threading
import time
import unittest

import rospy
import rostest
from std_msgs.msg import Float32

from avr_boards import ANNOUNCED, build_firmware
from boards import PACKAGE, PATIENCE, again_if_stalled, own_folder, until

ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
PAGE = os.path.join(ROOT, 'doc', 'tuning.md')
SKETCH = os.path.join(ROOT, 'firmware', 'protocol', 'examples', 'Tuning', 'Tuning.ino')
WANTED = f'/{PACKAGE}/settings'
STEP = 8.0
BACKGROUND = 'rosrun serial_communication avr_board', 'roslaunch', 'rostopic pub'


def read(path):
    with open(path, encoding='utf-8') as file:
        return file.read()


def blocks(language):
    """The blocks of the page that this test runs."""
    return re.findall(r'^<!-- run by: scripts/test ros -->\n```%s\n((?:.*\n)*?)```$' % language,
                      read(PAGE), re.M)


def commands():
    """The lines of the page that this test runs."""
    return [line for block in blocks('sh') for line in block.splitlines()]


class Tuning(unittest.TestCase):
    """Follows the page as a reader does."""

    def setUp(self):
        self.folder = own_folder()
        self.addCleanup(shutil.rmtree, self.folder)
        self.build = build_firmware()
        if rospy.has_param(WANTED):
            rospy.delete_param(WANTED)      # of the test before
        self.speeds, self.target = [], 0.0
        self.ended = threading.Event()
        self.addCleanup(self.ended.set)
        speed = rospy.Subscriber(f'/{PACKAGE}/wheel_speed', Float32,
                                 lambda message: self.speeds.append(message.data))
        self.addCleanup(speed.unregister)

    def run_line(self, line, shown=None):
        """Run a command of the page until it succeeds, and shows this; return what it shows."""
        for there, here in (
                ('$PWD/build', self.build), ('build/sketches', self.build + '/sketches'),
                ('/tmp/wheel', self.folder + '/wheel')):
            line = line.replace(there, here)
        if ' avr_board ' in line:
            line += f' --control {self.folder}/control'
        if line.startswith(BACKGROUND):
            process = subprocess.Popen(
                ['bash', '-c', 'exec ' + line], start_new_session=True, cwd=self.folder,
                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            self.addCleanup(process.wait, PATIENCE)
            self.addCleanup(os.killpg, process.pid, signal.SIGINT)
            return ''
        patient = '' if line.startswith('make') else f'timeout -k 5 {PATIENCE:g} '
        done = []

        def succeeds():     # again if the settings are not announced yet, as a reader does
            done[:] = [subprocess.run(['bash', '-c', patient + line], stdout=subprocess.PIPE,
                                      stderr=subprocess.STDOUT, encoding='utf-8',
                                      cwd=self.folder)]
            return done[0].returncode == 0 and shown in (None, done[0].stdout.replace(
                self.folder, '/tmp'))
        until(succeeds, f'{line} succeeds; it shows {shown}', 2 * PATIENCE)
        return done[0].stdout

    def emulated(self):
        """Seconds of the emulated chip, which pass slowly on a busy machine."""
        with socket.socket(socket.AF_UNIX) as control:
            control.connect(self.folder + '/control')
            control.sendall(b'get time\n')
            return float(control.recv(100))

    def until_announced(self, publisher):
        """Wait until the bridge knows the rows; each is sent many times in these seconds."""
        until(lambda: os.path.exists(self.folder + '/control'), 'the chip runs')
        end = self.emulated() + ANNOUNCED
        while not (publisher.get_num_connections() and self.speeds):
            self.assertLess(self.emulated(), end, 'the rows are not announced')
            time.sleep(0.1)

    def drive(self, publisher):
        """Send the target ten times a second, as `rostopic pub -r 10` does."""
        while not self.ended.wait(0.1):
            publisher.publish(self.target)

    def response(self):
        """The speeds, every 10 ms, from the first motion after a step."""
        self.target = 0.0
        until(lambda: self.speeds and self.speeds[-1] == 0, 'the wheel stands')
        del self.speeds[:]
        self.target = STEP
        until(lambda: len(self.speeds) > 400, '4 s')
        return list(itertools.dropwhile(lambda speed: speed == 0, self.speeds))

    def rises_in(self, least, most):
        """Check the seconds to 90 % of a step."""
        def rises():
            found = self.response()
            rise = 0.01 * len(list(itertools.takewhile(lambda s: s < 0.9 * STEP, found)))
            return least < rise < most
        again_if_stalled(rises)

    def test_the_page_tunes_the_wheel(self):
        lines = commands()
        drive, = [line for line in lines if line.startswith('rostopic pub')]
        before = lines[:lines.index(drive)]
        sets = [line for line in lines if ' dynparam set ' in line]
        shows = lines[lines.index(sets[-1]) + 1:]
        for line in before:
            self.run_line(line)
        publisher = rospy.Publisher(f'/{PACKAGE}/target', Float32, queue_size=1)
        threading.Thread(target=self.drive, args=[publisher], daemon=True).start()
        self.until_announced(publisher)
        self.rises_in(1.5, 2.5)
        for line in sets:
            self.run_line(line)
        self.rises_in(0.1, 0.3)
        used, wanted = [self.run_line(line) for line in shows]
        self.assertRegex(used, r"'kd': 0\.0.*'ki': 200\.0.*'kp': 40\.0")
        self.assertIn('ki: 200.0', wanted)
        self.assertIn('kp: 40.0', wanted)


if __name__ == '__main__':
    rospy.init_node('tuning_test')
    rostest.rosrun(PACKAGE, 'tuning', '__main__')
