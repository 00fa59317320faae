#!/usr/bin/python3
"""A port lent to a program: the services, the program `release`, and its end in every phase."""
import os
import shutil
import signal
import subprocess
import sys
import time

import rospy
import rostest
from std_srvs.srv import Empty

from boards import (PACKAGE, PATIENCE, SPEED_0_PACKET, WARN, BoardsTest, Bridge, CarBoard,
                    Diagnostics, Line, own_folder, program, service, until)
from serial_communication.boards.arduino.wire import Ticks
from serial_communication.msg import SpeedPWMCommand
from serial_communication.srv import Release

# A command that has the port open for some seconds, or until SIGUSR1.
BORROW = '''
import serial, signal, sys, time
signal.signal(signal.SIGUSR1, lambda *_: sys.exit())
port = serial.Serial(sys.argv[1], 57600, timeout=0.05)
print('open', flush=True)
time.sleep(float(sys.argv[2]))
'''
LOAN = 6.0      # s; a loan of `release` that is not renewed has ended


class LendingTest(BoardsTest):
    """One bridge for all tests, with a car that drives."""

    @classmethod
    def setUpClass(cls):
        folder = own_folder()
        cls.addClassCleanup(shutil.rmtree, folder, ignore_errors=True)
        line = Line(os.path.join(folder, 'arduino')).plug()
        cls.addClassCleanup(line.unplug)
        cls.board = CarBoard(line.far)
        cls.addClassCleanup(cls.board.close)
        cls.board.write(b'\0')     # so that it is never silent
        cls.parameters = {'arduino/port': line.near, 'arduino/speed_timeout': 0.0}
        cls.start_car_bridge()
        cls.addClassCleanup(lambda: cls.bridge.kill())
        cls.speed = rospy.Publisher('/%s/speed' % PACKAGE, SpeedPWMCommand, queue_size=1)

    @classmethod
    def start_car_bridge(cls):
        """Start the bridge; again, if it has been killed."""
        cls.bridge = Bridge(parameters=cls.parameters)

    def setUp(self):
        super().setUp()
        self.diagnostics = Diagnostics()
        self.addCleanup(self.diagnostics.close)
        self.drive()

    def drive(self):
        """Let the car drive."""
        self.board.forget()
        until(lambda: 300 in self.board.speeds,
              doing=lambda: self.speed.publish(SpeedPWMCommand(value=300)))

    def program(self, *command, link='arduino'):
        """Start `release LINK -- COMMAND`; its output is a pipe."""
        process = subprocess.Popen([program('release'), link, '--', *command],
                                   stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                                   stderr=subprocess.STDOUT, universal_newlines=True)
        self.addCleanup(process.stdout.close)
        self.addCleanup(process.wait)
        self.addCleanup(process.kill)
        return process

    def borrow(self, seconds=600.0):
        """Start a program that borrows the port, and return it when its command has it open."""
        process = self.program(sys.executable, '-c', BORROW, '{port}', str(seconds))
        self.assertEqual(process.stdout.readline(), 'open\n')
        self.check_lent()
        return process

    def ends(self, process, status):
        """Check the exit status of the program, whose output is then returned."""
        self.assertEqual(process.wait(PATIENCE), status)
        return process.stdout.read()

    @staticmethod
    def children_of(parent):
        """The ids of the children of a process, or of its id; none once it has ended."""
        pid = getattr(parent, 'pid', parent)
        try:
            with open('/proc/%d/task/%d/children' % (pid, pid)) as file:
                return list(map(int, file.read().split()))
        except OSError:
            return []

    def check_lent(self):
        """The last packet is SPEED 0, and nothing follows it."""
        until(lambda: bytes(self.board.wire).endswith(SPEED_0_PACKET), 'SPEED 0 is the last packet')
        self.board.forget()

    def check_back(self, seconds=10.0):
        """The first packet is SPEED 0, and heartbeats follow."""
        until(lambda: self.board.heartbeats() > 3, 'heartbeats', seconds)
        self.assertEqual(bytes(self.board.wire).lstrip(b'\0')[:5], SPEED_0_PACKET)

    @staticmethod
    def lend(by, seconds, link='/%s/arduino' % PACKAGE):
        """Borrow a port with the service, which refuses after a stall of this machine."""
        release = service(link + '/release', Release)
        return until(lambda: next((a for a in [release(by, seconds)] if a.success), None),
                     'the port is lent', every=0.1)

    def check_state(self, level, words):
        self.diagnostics.fresh('arduino', lambda status: status.level == level
                               and words in status.message, words)

    # -- the services ---------------------------------------------------------------------

    def test_the_service_lends_and_takes_back(self):
        release = service('/%s/arduino/release' % PACKAGE, Release)
        self.assertEqual(self.lend('arduino-cli', 10.0).message, 'lent to arduino-cli')
        self.check_lent()
        self.diagnostics.fresh('arduino', lambda status: status[:2] == (
            WARN, 'lent to arduino-cli'), 'lent')

        def refused():
            try:
                service('/%s/calibrate_imu' % PACKAGE, Empty)()
            except rospy.ServiceException as error:
                return 'lent to arduino-cli' in str(error)      # not a stall
        until(refused, 'it says why', every=0.1)
        self.assertFalse(release('minicom', 5.0).success)
        self.assertEqual(bytes(self.board.wire), b'')
        self.assertTrue(release('arduino-cli', 0.0).success)
        self.check_back(3.0)
        self.diagnostics.fresh('arduino', lambda status: status.message == 'open', 'open',
                               lambda: self.board.say(Ticks(1)))

    # -- the program ----------------------------------------------------------------------

    def test_a_command_borrows_the_port_and_gives_it_back(self):
        process, began = self.borrow(), time.monotonic()
        self.check_state(WARN, 'lent to python3 (pid %d)' % process.pid)
        shown = subprocess.run([program('monitor'), '--once'], stdout=subprocess.PIPE,
                               universal_newlines=True, timeout=PATIENCE)
        self.assertIn('lent to python3 (pid %d)' % process.pid, shown.stdout)
        until(lambda: time.monotonic() > began + LOAN, 'the loan was renewed')
        self.assertEqual(bytes(self.board.wire), b'')
        os.kill(self.children_of(process)[0], signal.SIGUSR1)
        self.assertEqual(self.ends(process, 0), '')
        self.check_back(4.0)
        self.assertTrue(self.bridge.alive)

    def test_the_exit_status_is_the_commands(self):
        for status, command in ((3, 'exit 3'), (137, 'kill -9 $$')):
            process = self.program('sh', '-c', command)
            self.assertEqual((process.wait(60), process.stdout.read()), (status, ''))

    def test_what_cannot_be_done_is_said(self):
        for status, words, arguments in (
                (127, 'there is no program nothing-there', ['arduino', '--', 'nothing-there']),
                (125, 'no bridge /serial_communication with a port of mcu', ['mcu', '--', 'true']),
                (125, 'no bridge /other with', ['arduino', '--node', 'other', '--', 'true'])):
            done = subprocess.run([program('release'), *arguments], stdout=subprocess.PIPE,
                                  stderr=subprocess.STDOUT, universal_newlines=True,
                                  timeout=PATIENCE)
            self.assertEqual(done.returncode, status, done.stdout)
            self.assertIn(words, ' '.join(done.stdout.split()))
        self.lend('me', 60.0)
        self.assertIn('the port is lent to me', self.ends(self.program('true'), 125))
        self.assertTrue(service('/%s/arduino/release' % PACKAGE, Release)('me', 0.0).success)

    # -- what is killed or suspended --------------------------------------------------------

    def test_kill_of_the_program(self):
        process = self.borrow()
        command, = self.children_of(process)
        process.kill()
        until(lambda: not os.path.exists('/proc/%d' % command), 'its command is killed, too')
        self.check_back()


if __name__ == '__main__':
    rospy.init_node('lending_test')
    rostest.rosrun(PACKAGE, 'lending', '__main__')
