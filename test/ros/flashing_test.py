#!/usr/bin/python3
"""Follows doc/flashing.md: avrdude flashes an emulated Nano with Arduino's own bootloader through
`release`, while roslaunch runs; and what is killed meanwhile."""
import os
import re
import shutil
import signal
import subprocess
import time
import unittest
from xmlrpc.client import ServerProxy

import psutil
import rosgraph
import rospy
import rostest
from std_msgs.msg import UInt16

from avr_boards import EmulatedBoard, build_firmware
from boards import (Output, PACKAGE, PATIENCE, Diagnostics, Topic, again_if_stalled,
                    command_topic, own_folder, until, wait_for_launch)
from emulated_board import BOOTLOADER
from serial_communication.msg import SpeedPWMCommand

ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
PAGE = os.path.join(ROOT, 'doc', 'flashing.md')
UPLOAD = 6 * PATIENCE       # s for an upload on a busy machine
OUT_OF_SYNC = re.compile('protocol expects|not in sync')     # what avrdude says
PART = 1500                 # bytes; an upload that has sent so many is under way


def commands():
    """The page's blocks of commands without a board, one list of lines each."""
    with open(PAGE, encoding='utf-8') as page:
        blocks = re.findall(r'^<!-- run by: scripts/test ros -->\n```sh\n(.*?)^```$', page.read(),
                            re.M | re.S)
    return [block.splitlines() for block in blocks]


class Flashing(unittest.TestCase):
    """The page's board, and roslaunch, which runs from the first line to the last."""

    def setUp(self):
        self.folder = own_folder()
        self.addCleanup(shutil.rmtree, self.folder, ignore_errors=True)
        (board, launch), *self.rest = commands()
        self.build = build_firmware()
        self.assertIn('avr_board arduino --link /tmp/nano --bootloader ' + BOOTLOADER, board)
        self.board = EmulatedBoard(self.build, 'car', bootloader=BOOTLOADER)
        self.addCleanup(self.board.close)
        self.output = Output()
        self.addCleanup(self.output.close)
        self.launched = subprocess.Popen(
            ['bash', '-c', 'exec ' + launch.replace('/tmp/nano', self.board.port)],
            stdout=self.output, stderr=subprocess.STDOUT)
        self.addCleanup(self.end)
        wait_for_launch()
        self.diagnostics = Diagnostics()
        self.addCleanup(self.diagnostics.close)

    def end(self):
        """Send Ctrl-C; return the output."""
        if self.launched.poll() is None:
            self.launched.send_signal(signal.SIGINT)
        self.assertEqual(self.launched.wait(PATIENCE), 0)
        return self.output.text()

    def start(self, line):
        """Start a line of the page."""
        process = subprocess.Popen(
            ['bash', '-c', 'exec ' + line.replace('BUILD=$PWD/build', 'BUILD=' + self.build)],
            cwd=self.folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            universal_newlines=True)
        self.addCleanup(process.stdout.close)
        self.addCleanup(process.wait)
        self.addCleanup(process.kill)
        return process

    def run_line(self, line):
        """Run it; return its output."""
        process = self.start(line)
        output = process.communicate(timeout=UPLOAD)[0]
        self.assertEqual(process.returncode, 0, output)
        return output

    def upload(self, line, process=None):
        """Run the line that flashes, or wait for its process; return the output. Again if the
        emulated bootloader, on a busy machine, has answered so late that avrdude had asked twice
        and got both answers."""
        for _ in range(5):
            process = process or self.start(line)
            output = process.communicate(timeout=UPLOAD)[0]
            if not (process.returncode and OUT_OF_SYNC.search(output)):
                break
            process = None
        self.assertEqual(process.returncode, 0, output)
        return output

    def bridge(self):
        """The process id of the bridge."""
        uri = rosgraph.Master('/flashing_test').lookupNode('/' + PACKAGE)
        return ServerProxy(uri).getPid('/flashing_test')[2]

    def drive(self):
        """Let the motor run. The car has to listen already."""
        speed = command_topic('/%s/speed' % PACKAGE, SpeedPWMCommand)
        until(lambda: self.board.get('motor_pwm') == 128, 'the motor runs', UPLOAD,
              doing=lambda: speed.publish(value=500))
        return speed

    @staticmethod
    def check_topic(name):
        """The new sketch's announcement has taken over."""
        topic = Topic('/%s/%s' % (PACKAGE, name), UInt16, wait=False)
        topic.first(what='is published', seconds=UPLOAD)
        topic.close()

    def test_a_new_sketch_is_in_and_its_announcement_takes_over(self):
        (copy, edit, upload, look), = self.rest
        bridge, speed = self.bridge(), self.drive()
        self.run_line(copy)
        began = time.monotonic()
        self.run_line(edit)
        process = self.start(upload)
        until(lambda: self.board.get('motor_pwm') == 0, 'the motor stops',
              doing=lambda: speed.publish(value=500))
        output = self.upload(upload, process)
        self.assertIn('bytes of flash verified', output)
        uploaded = time.monotonic()
        self.assertIn('data:', self.run_line(look))
        print('edit to the end of the upload %.1f s, to the topic %.1f s'
              % (uploaded - began, time.monotonic() - began))
        self.assertEqual(self.bridge(), bridge, 'the bridge has not been started again')
        self.assertIn('announces brightness, lamp (firmware hello 1.0)', self.end())

    def test_an_upload_that_is_killed_leaves_the_port_to_the_next(self):
        copy, _, upload, _ = self.rest[0]
        self.run_line(copy)
        for victim in 'avrdude', 'release', 'bridge':
            bridge = self.bridge()
            process, avrdude = again_if_stalled(lambda: self.begin(upload))
            os.kill(bridge if victim == 'bridge' else process.pid if victim == 'release'
                    else avrdude, signal.SIGKILL)
            if victim == 'bridge':
                until(lambda: self.bridge_or_0() not in (0, bridge), 'it starts again', UPLOAD)
                process.terminate()     # avrdude, disturbed, once took over 360 s
            process.wait(UPLOAD)
            if victim != 'bridge':
                self.assertNotEqual(process.returncode, 0)
            self.diagnostics.forget()
            until(lambda: any(status.message.startswith('open')
                              for status in self.diagnostics.statuses('arduino')),
                  'the port is open again', UPLOAD)
        # Whatever is left of a sketch: the next upload is whole.
        self.upload(upload)
        self.check_topic('light')

    def begin(self, upload):
        """Start an upload; return its process and avrdude's while it writes, None if it is over."""
        process = self.start(upload)
        until(lambda: self.avrdude_of(process) or process.poll() is not None,
              'avrdude runs', UPLOAD)
        before = self.board.get('rx_bytes')
        until(lambda: self.board.get('rx_bytes') > before + PART or process.poll() is not None,
              'it writes', UPLOAD)
        avrdude = self.avrdude_of(process)
        if avrdude:
            return process, avrdude
        self.upload(upload, process)
        return None

    def bridge_or_0(self):
        try:
            return self.bridge()
        except (OSError, rosgraph.MasterException):
            return 0

    @staticmethod
    def avrdude_of(process):
        """The id of avrdude's process below this one; None if there is none (any more)."""
        try:
            for child in psutil.Process(process.pid).children(recursive=True):
                if child.name() == 'avrdude':
                    return child.pid
        except psutil.NoSuchProcess:
            pass        # one has ended
        return None


if __name__ == '__main__':
    rospy.init_node('flashing_test')
    rostest.rosrun(PACKAGE, 'flashing', '__main__')
