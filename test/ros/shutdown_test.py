#!/usr/bin/python3
"""However the bridge is stopped, SPEED 0 is its last packet, and it ends within 2 s."""
import os
import shutil
import signal
import threading
import unittest

import rosnode
import rospy
import rostest

from boards import (PACKAGE, SPEED_0_PACKET, TIMEOUT, Bridge, BusBoard, CarBoard, Line, Waiter,
                    command_topic, own_folder, service, settle, until)
from serial_communication.msg import SpeedPWMCommand
from serial_communication.srv import Lift

SECONDS = 2.0


class Shutdown(unittest.TestCase):
    """A car that drives, a lift that may be moving, and a signal."""

    @classmethod
    def setUpClass(cls):
        cls.folder = own_folder()
        cls.lines = [Line(os.path.join(cls.folder, name)).plug() for name in ('bus', 'arduino')]
        cls.bus, cls.car = BusBoard(cls.lines[0].far), CarBoard(cls.lines[1].far)

    @classmethod
    def tearDownClass(cls):
        for part in cls.bus, cls.car:
            part.close()
        for line in cls.lines:
            line.unplug()
        shutil.rmtree(cls.folder)

    def setUp(self):
        self.car.forget()
        self.start_bridge()
        self.speed = command_topic('/serial_communication/speed', SpeedPWMCommand)
        self._driving = threading.Event()
        self._driver = threading.Thread(target=self.drive, daemon=True)
        self._driver.start()
        until(lambda: 400 in self.car.speeds, 'the car drives')

    def start_bridge(self, **arguments):
        """Start a bridge, and wait until it is in step with its boards."""
        self.bridge = Bridge(parameters={
            'bus/port': self.lines[0].near, 'arduino/port': self.lines[1].near,
            'bus/motion_timeout': 60.0, 'bus/environment_period': 0.0}, **arguments)
        settle(PACKAGE, self.bus)

    def tearDown(self):
        self.stop_driving()
        self.bridge.kill()

    def drive(self):
        """Publish commands without a pause, even while the bridge ends."""
        while not self._driving.wait(0.02):
            self.speed.publish(value=400)

    def stop_driving(self):
        self._driving.set()
        self._driver.join()
        self.speed.unregister()

    def assert_ended(self, seconds, status):
        self.assertLess(seconds, SECONDS)
        self.assertGreaterEqual(status, 0, 'a signal killed it')
        self.assertNotIn('Traceback', self.bridge.output())
        until(lambda: self.car.raws[-1:] == [SPEED_0_PACKET], 'SPEED 0 is the last packet: %s'
              % self.car.raws[-3:])
        self.assertEqual(self.car.speeds[:-1], [400] * (len(self.car.speeds) - 1))
        # Nothing follows, not even part of a packet.
        self.assertEqual(bytes(self.car.wire[-5:]), SPEED_0_PACKET)

    def test_sighup_under_nohup_does_not_end_the_bridge(self):
        self.bridge.end()
        # This is what nohup does; ignored signals are inherited.
        self.start_bridge(before=('sh', '-c', 'trap "" HUP; exec "$@"', 'nohup'))
        self.bridge.process.send_signal(signal.SIGHUP)
        self.car.forget()
        self.car.wait_for_heartbeats(100)
        self.assertTrue(self.bridge.alive)
        self.assert_ended(*self.bridge.end(signal.SIGTERM))

    def test_rosnode_kill_stops_the_car_and_ends_the_bridge(self):
        ended = Waiter(self.bridge.process.wait, 15)
        rosnode.kill_nodes(['/' + PACKAGE])
        self.assert_ended(0.0, ended.result())
        self.assertLess(ended.took, SECONDS + 1.0)

    def test_a_waiting_lift_call_is_answered_and_delays_nothing(self):
        for number in signal.SIGINT, signal.SIGTERM, signal.SIGHUP:
            with self.subTest(signal=number):
                if number != signal.SIGINT:
                    self.stop_driving()
                    self.setUp()
                self.bus.script.append(b'')
                waiter = Waiter(service('/serial_communication/lift', Lift), 0, 100)
                until(lambda: self.bus.others, 'the request is on the wire')
                self.assert_ended(*self.bridge.end(number))
                waiter.join(5)
                self.assertFalse(waiter.is_alive(), 'the caller still waits')
                if waiter.answer is not None:      # otherwise its connection was closed
                    self.assertEqual(waiter.answer.status, TIMEOUT)


if __name__ == '__main__':
    rospy.init_node('shutdown_test')
    rostest.rosrun(PACKAGE, 'shutdown', '__main__')
