#!/usr/bin/python3
"""A bridge whose log cannot be written: its links go on as if nothing were."""
import os
import shutil
import unittest

import rospy
import rostest

from boards import (NOT_SENT, PACKAGE, SPEED_0_PACKET, TIMEOUT, Bridge, BusBoard, CarBoard, Line,
                    Topic, command_topic, own_folder, service, settle, until)
from serial_communication.msg import SpeedPWMCommand, Voltage
from serial_communication.protocols import arduino
from serial_communication.srv import Lift


class Unwritable:
    """Both output streams of a bridge; each test is the same for each kind of them."""

    def setUp(self):
        self.folder = own_folder()
        self.lines = {link: Line(os.path.join(self.folder, link)).plug()
                      for link in ('bus', 'arduino')}
        self.bus = BusBoard(self.lines['bus'].far)
        self.car = CarBoard(self.lines['arduino'].far)
        self.descriptors = []
        self.bridge = Bridge(stdout=self.output(), parameters={
            'bus/port': self.lines['bus'].near, 'arduino/port': self.lines['arduino'].near,
            'bus/motion_timeout': 0.5, 'bus/reply_timeout': 0.3, 'bus/environment_period': 0.0,
            'arduino/speed_timeout': 0.2})
        self.voltage = Topic('/serial_communication/voltage', Voltage)
        settle(PACKAGE, self.bus)
        self.assert_data_flows()
        self.spoil()

    def spoil(self):
        """From now on the output cannot be written, if it could so far."""

    def tearDown(self):
        self.voltage.close()
        if self.bridge.alive:
            self.bridge.process.kill()
            self.bridge.process.wait(10)
        for board in self.bus, self.car:
            board.close()
        for line in self.lines.values():
            line.unplug()
        for descriptor in self.descriptors:
            os.close(descriptor)
        shutil.rmtree(self.folder)

    def assert_data_flows(self):
        """A measurement comes through."""
        self.voltage.next(doing=lambda: self.car.say(arduino.Voltage(12.0)))

    def test_a_port_that_returns_carries_data_again(self):
        self.lines['arduino'].unplug()
        until(lambda: not self.car.connected, 'the board has lost its line')
        lift = service('/serial_communication/lift', Lift)
        self.lines['bus'].unplug()
        until(lambda: lift(0, 1).status == NOT_SENT, 'the bridge has noticed')
        for line in self.lines.values():
            line.plug()
        until(lambda: self.car.connected and self.bus.connected, 'both boards are back')
        self.assert_data_flows()
        until(lambda: lift(0, 1).success, 'the lift answers')

    def test_measurements_go_on_after_the_warning_of_a_speed_timeout(self):
        speed = command_topic('/serial_communication/speed', SpeedPWMCommand)
        for value in 300, 310:
            speed.publish(value=value)
            until(lambda v=value: v in self.car.speeds and SPEED_0_PACKET in self.car.commands[
                self.car.speeds.index(v):], 'SPEED 0 after %d' % value)
            self.assert_data_flows()
        speed.unregister()

    def test_the_call_after_one_that_timed_out_is_answered(self):
        self.bus.script.append(b'')
        lift = service('/serial_communication/lift', Lift)
        self.assertEqual(lift(0, 1).status, TIMEOUT)
        answer = lift(0, 2)
        self.assertTrue(answer.success, answer.message)

    def test_heartbeats_go_on_and_the_end_is_orderly(self):
        self.bus.write(bytes(1000))      # noise, which is worth a line
        self.lines['bus'].unplug()
        self.car.forget()
        self.car.wait_for_heartbeats(100)
        seconds, status = self.bridge.end()
        self.assertEqual(status, 0)
        self.assertLess(seconds, 2.0)
        until(lambda: self.car.raws[-1:] == [SPEED_0_PACKET], 'SPEED 0 is the last packet')


class ClosedPipe(Unwritable, unittest.TestCase):
    """Whoever read it has gone."""

    def output(self):
        self.descriptors += os.pipe()
        return self.descriptors[1]

    def spoil(self):
        os.close(self.descriptors.pop(0))


class FullPipe(Unwritable, unittest.TestCase):
    """Whoever should read it does not, as a terminal after Ctrl-S."""

    output = ClosedPipe.output

    def spoil(self):
        # Opened once more, since whether writing waits is shared with the bridge otherwise.
        writing = os.open('/proc/self/fd/%d' % self.descriptors[1], os.O_WRONLY | os.O_NONBLOCK)
        for size in 4096, 1:
            try:
                while True:
                    os.write(writing, bytes(size))
            except BlockingIOError:
                pass
        os.close(writing)


class FullDisk(Unwritable, unittest.TestCase):
    """A file that takes nothing more."""

    def output(self):
        self.descriptors.append(os.open('/dev/full', os.O_WRONLY))
        return self.descriptors[-1]


if __name__ == '__main__':
    rospy.init_node('log_test')
    rostest.rosrun(PACKAGE, 'log', '__main__')
