#!/usr/bin/python3
"""Follows doc/custom_messages.md and doc/announcements.md step by step: their files, commands and
sketches, compiled as the Arduino IDE does, on an emulated board."""
import os
import re
import shutil
import signal
import subprocess
import unittest

import rospy
import rostest
from std_msgs.msg import Float32, UInt16

from avr_boards import EmulatedBoard, build_firmware
from boards import Output, PACKAGE, PATIENCE, Topic, own_folder, until

ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
FILE, ANNOUNCED = (os.path.join(ROOT, 'doc', name + '.md')
                   for name in ('custom_messages', 'announcements'))
PORT = '/dev/ttyUSB0'          # the pages' names of the port of a board …
CHIP = '/tmp/my_robot'         # … and of an emulated chip
VALUES = {'force': (Float32, 'a6', 500, 145.0), 'light': (UInt16, 'a0', 512, 512)}
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
        self.board = self.chip = None
        self.port = ''
        self.addCleanup(self.unplug)

    def end(self):
        """Send Ctrl-C to roslaunch."""
        if self.launched and self.launched.poll() is None:
            os.killpg(self.launched.pid, signal.SIGINT)
            self.launched.wait(PATIENCE)

    def unplug(self):
        """End the emulated board, and the chip that the page starts."""
        if self.board:
            self.board.close()
        if self.chip:
            self.chip.terminate()
            self.chip.communicate(timeout=PATIENCE)

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
        self.board, self.chip = EmulatedBoard(self.build, 'pins', image=image), None
        self.port = self.board.port
        for _, pin, raw, _ in VALUES.values():
            self.board.set(pin, raw)

    def start_chip(self, line):
        """Run an avr_board of the page until the next sketch is flashed."""
        self.chip = subprocess.Popen(['bash', '-c', 'exec ' + line], cwd=self.folder,
                                     stdout=subprocess.PIPE, encoding='utf-8')
        self.port = os.path.join(self.folder, 'chip')
        self.assertRegex(self.chip.stdout.readline(), '^avr_emulator: .*/my_robot.elf on ')

    def run_line(self, line):
        """Run one line of a block of commands."""
        if line.startswith('arduino-cli'):
            self.flash(line.split()[-1])
            return
        for shown, here in (
                (PORT, self.port), (CHIP, os.path.join(self.folder, 'chip')),
                ('$PWD/build', self.build), ('build/sketches', self.build + '/sketches')):
            line = line.replace(shown, here)
        if ' avr_board ' in line:
            self.start_chip(line)
            return
        if line.startswith('roslaunch'):
            self.end()
            self.output = Output()
            self.launched = subprocess.Popen(['bash', '-c', 'exec ' + line], cwd=self.folder,
                                             stdout=self.output, stderr=subprocess.STDOUT,
                                             start_new_session=True)
            # roslaunch, the simulated boards and the bridge start one after the other.
            until(lambda: 'open' in self.said(), f'{line} opens a port', every=0.1)
            return
        # Repeat it if the bridge was not running yet, as a reader does. A tool of ROS that is ended
        # while it starts may never end. A build takes its time.
        patient = '' if line.startswith(('make', 'echo')) else f'timeout -k 5 {PATIENCE:g} '
        until(lambda: subprocess.run(
            ['bash', '-c', patient + line], cwd=self.folder, stdout=subprocess.DEVNULL,
            stderr=subprocess.STDOUT).returncode == 0, f'{line} succeeds', 4 * PATIENCE)

    def said(self):
        """The output of roslaunch."""
        return self.output.text()

    def test_every_step_of_the_page_with_a_file_works(self):
        self.assertGreater(self.follow(FILE), 8)
        self.publish_until(lambda: self.board.get('pwm11') == (500 + 1000) * 255 // 2000)

    def test_every_step_of_the_page_without_a_file_works(self):
        self.assertGreater(self.follow(ANNOUNCED), 10)
        self.assertEqual([name for name in os.listdir(self.folder) if name.endswith('.yaml')], [])
        # A board that is emulated slower than its baud rate is asked again.
        until(lambda: 'arduino: announces light, lamp (firmware hello 1.0)' in self.said(),
              'the bridge has the announcement', 4 * PATIENCE)
        self.publish_until(lambda: self.board.get('d13') == 1)

    def publish_until(self, condition):
        """Repeat the last command of the page to the board, which is refused after a stall."""
        until(condition, self.published, 4 * PATIENCE, doing=lambda: self.run_line(self.published))

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
                    if line.startswith('rostopic pub'):
                        self.published = line
                    commands += 1
                    self.check(line)
        return commands

    def check(self, line):
        """Check what the page says about a command."""
        topic = line.rpartition('/')[2]
        if self.port and line.startswith('rostopic echo') and topic in VALUES:
            kind, _, _, value = VALUES[topic]
            topic = Topic('/serial_communication/' + topic, kind)
            topic.first(lambda m: abs(m.data - value) < 1e-3, what=f'is {value}')
            topic.close()


if __name__ == '__main__':
    rospy.init_node('custom_tutorial_test')
    rostest.rosrun(PACKAGE, 'custom_tutorial', '__main__')
