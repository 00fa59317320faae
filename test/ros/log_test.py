#!/usr/bin/python3
"""A bridge whose log cannot be written: its links work as usual."""
import os

import rospy
import rostest

from boards import (NOT_SENT, PACKAGE, SPEED_0_PACKET, BoardsTest, BusBoard, CarBoard, Topic,
                    service, settle, until)
from serial_communication.msg import Voltage
from serial_communication.boards.arduino import wire as arduino
from serial_communication.srv import Lift


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


if __name__ == '__main__':
    rospy.init_node('log_test')
    rostest.rosrun(PACKAGE, 'log', '__main__')
