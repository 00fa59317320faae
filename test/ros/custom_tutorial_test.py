#!/usr/bin/python3
"""Follows doc/custom_messages.md and doc/announcements.md step by step: their files, commands and
sketches, compiled as the Arduino IDE does, on an emulated board."""
import os
import re
import shutil
import signal
import subprocess
import tempfile
import unittest

import rospy
import rostest
from std_msgs.msg import Float32

from avr_boards import EmulatedBoard, build_firmware, until_announced
from boards import PACKAGE, PATIENCE, Topic, own_folder, until

ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
FILE, ANNOUNCED = (os.path.join(ROOT, 'doc', name + '.md')
                   for name in ('custom_messages', 'announcements'))
SKETCHES = ('ctrl_board/ctrl_board.ino',)
PORT = '/dev/ttyUSB0'      # the page's name of the port
ARDUINO = '/usr/share/arduino/hardware/arduino/avr'
COMPILE = ['avr-g++', '-mmcu=atmega328p', '-DF_CPU=16000000L', '-DARDUINO=10819',
           '-DARDUINO_AVR_NANO', '-DARDUINO_ARCH_AVR', '-Os', '-Wall', '-Wextra',
           '-std=gnu++11', '-fno-exceptions', '-fno-threadsafe-statics',
           '-I' + ARDUINO + '/cores/arduino', '-I' + ARDUINO + '/variants/eightanaloginputs',
           '-I' + os.path.join(ROOT, 'firmware', 'protocol', 'src'), '-include', 'Arduino.h']


def blocks(path):
    """A page's blocks of code: (language, file, text)."""
    with open(path, encoding='utf-8') as page:
        return re.findall(r'^```(\w+) ?(.*)\n((?:.*\n)*?)```$', page.read(), re.M)


class Tutorial(unittest.TestCase):
    """Follows the pages as a reader does."""

    def setUp(self):
        self.folder = own_folder()
        self.addCleanup(shutil.rmtree, self.folder, ignore_errors=True)
        self.launched = None
        self.addCleanup(self.end)
        if rospy.has_param('/' + PACKAGE):      # of another page
            rospy.delete_param('/' + PACKAGE)
        self.build = build_firmware()
        self.board = None
        self.addCleanup(self.unplug)

    def end(self):
        """Send Ctrl-C to roslaunch."""
        if self.launched and self.launched.poll() is None:
            os.killpg(self.launched.pid, signal.SIGINT)
            self.launched.wait(PATIENCE)

    def unplug(self):
        """End the emulated board."""
        if self.board:
            self.board.close()

    def flash(self, name):
        """Compile a sketch as the IDE does, and start it on an emulated board."""
        folder = os.path.join(self.folder, name)
        sketch, image = os.path.join(folder, name + '.ino'), os.path.join(folder, name + '.elf')
        done = subprocess.run(
            [*COMPILE, '-x', 'c++', sketch, '-x', 'none', os.path.join(self.build, 'arduino.a'),
             '-Wl,--gc-sections', '-lm', '-o', image], stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, encoding='utf-8')
        self.assertEqual((done.returncode, done.stdout), (0, ''))
        self.end()
        self.unplug()
        self.board = EmulatedBoard(self.build, 'car', image=image)
        self.board.set('force', 500)

    def run_line(self, line):
        """Run one line of a block of commands."""
        if line.startswith('arduino-cli'):
            self.flash(line.split()[-1])
            return
        if self.board:
            line = line.replace(PORT, self.board.port)
        if line.startswith('roslaunch'):
            self.end()
            self.output = tempfile.TemporaryFile('w+')
            self.launched = subprocess.Popen(['bash', '-c', 'exec ' + line], cwd=self.folder,
                                             stdout=self.output, stderr=subprocess.STDOUT,
                                             start_new_session=True)
            # roslaunch, the simulated boards and the bridge start one after the other.
            until(lambda: 'open' in self.said(), f'{line} opens a port', 4 * PATIENCE, every=0.1)
            return
        # Repeat it if the bridge was not running yet, as a reader does. A tool of ROS that is ended
        # while it starts may never end.
        command = ['bash', '-c', f'timeout -k 5 {PATIENCE:g} {line}']
        until(lambda: subprocess.run(command, cwd=self.folder, stdout=subprocess.DEVNULL,
                                     stderr=subprocess.STDOUT).returncode == 0,
              f'{line} succeeds', 4 * PATIENCE)

    def said(self):
        """The output of roslaunch."""
        self.output.seek(0)
        return self.output.read()

    def test_every_step_of_the_page_with_a_file_works(self):
        self.assertGreater(self.follow(FILE), 8)

    def test_every_step_of_the_page_without_a_file_works(self):
        self.assertGreater(self.follow(ANNOUNCED), 6)
        self.assertEqual(os.listdir(self.folder), ['my_robot'])
        self.assertIn('arduino: announces force, gripper (firmware my_robot 1.1)', self.said())

    def follow(self, page):
        """Do what a page says; return the number of its commands."""
        commands = 0
        os.makedirs(os.path.join(self.folder, 'my_robot'))
        for language, name, text in blocks(page):
            if name:
                with open(os.path.join(self.folder, name), 'w', encoding='utf-8') as file:
                    file.write(text)
            elif language == 'bash':
                for line in text.splitlines():
                    self.run_line(line)
                    commands += 1
                    self.check(line)
        return commands

    def check(self, line):
        """Check what the page says about a command."""
        if PORT in line and line.startswith('roslaunch'):
            topic = Topic('/serial_communication/force', Float32, wait=False)
            until_announced(self.board, topic)
            topic.first(lambda m: abs(m.data - 145.0) < 1e-3, what='is 500 * 29 / 100 N')
            topic.close()
        if 'rostopic pub' in line:
            until(lambda: self.board.get('gripper_pwm') == (500 + 1000) * 255 // 2000,
                  'the gripper moves')

    def test_the_page_has_the_firmware_of_the_sketches(self):
        sources = ''
        for sketch in SKETCHES:
            with open(os.path.join(ROOT, 'firmware', sketch), encoding='utf-8') as file:
                sources += file.read()
        shown = [text for language, name, text in blocks(FILE) if language == 'cpp' and not name]
        self.assertGreater(len(shown), 1)
        for text in shown:
            for part in text.strip('\n').split('\n\n'):
                self.assertIn(part, sources)

    def test_the_example_has_a_sketch_of_fifteen_lines_and_five_of_yaml(self):
        rows = [text for language, _, text in blocks(FILE) if language == 'yaml'][0]
        self.assertLessEqual(len(rows.splitlines()), 5)
        sketch = [text for _, name, text in blocks(FILE) if name.endswith('.ino')][0]
        self.assertLessEqual(len(sketch.splitlines()), 15)


if __name__ == '__main__':
    rospy.init_node('custom_tutorial_test')
    rostest.rosrun(PACKAGE, 'custom_tutorial', '__main__')
