#!/usr/bin/python3
"""With simulated time that never starts, all periods and timeouts still work; once it starts,
stamps are compared with it."""
import threading
import unittest

import rospy
import rostest
from diagnostic_msgs.msg import DiagnosticArray
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

from boards import (PACKAGE, TIMEOUT, BusBoard, CarBoard, Rosout, SensorBoard, Topic, command_topic,
                    level_imu, ranges, service, settle, until)
from serial_communication.msg import Environment, McuStatus2, SpeedPWMCommand
from serial_communication.boards.bus import wire as bus
from serial_communication.srv import GetEnvironment, Lift


def setUpModule():
    """The three boards."""
    global BUS, CAR, SENSORS
    line = rospy.get_param('~line')
    BUS, CAR, SENSORS = (BusBoard(line + '_bus_board', polled=True),
                         CarBoard(line + '_arduino_board'), SensorBoard(line + '_mcu_board'))
    BUS.air = bus.Environment(1, 2.0, 3.0)


class SimulatedTime(unittest.TestCase):
    """No /clock is published."""

    @classmethod
    def setUpClass(cls):
        assert rospy.Time.now() == rospy.Time(0), 'time stands still'
        settle(PACKAGE, BUS)
        until(lambda: CAR.heartbeats() and SENSORS.connected, 'the other boards are there')

    def test_heartbeats_are_sent(self):
        CAR.wait_for_heartbeat_rate(40, 130)

    def test_a_speed_that_is_not_renewed_ends_in_speed_0(self):
        CAR.forget()
        command_topic('/serial_communication/speed', SpeedPWMCommand).publish(value=300)
        until(lambda: CAR.speeds == [300, 0], 'SPEED 0')

    def test_services_answer_and_time_out(self):
        lift = service('/serial_communication/lift', Lift)
        self.assertTrue(lift(0, 100).success)
        self.assertTrue(service('/serial_communication/get_environment',
                                GetEnvironment)().success)
        BUS.script.append(b'')
        self.assertEqual(lift(0, 100).status, TIMEOUT)
        until(lambda: service('/serial_communication/bus/echo', Trigger)().success, 'an echo')

    def test_readings_of_the_air_are_polled_and_published(self):
        topic = Topic('/serial_communication/environment', Environment)
        until(lambda: len(topic.messages) >= 3, 'three readings')

    def test_measurements_are_published_with_a_stamp_of_0(self):
        topic = Topic('/serial_communication/imu', Imu)
        message = topic.first(doing=lambda: CAR.say(level_imu()))
        self.assertEqual(message.header.stamp, rospy.Time(0))

    def test_a_silent_mcu_board_is_reported(self):
        topic = Topic('/mcu/status', McuStatus2)
        topic.first(lambda m: m.connected, doing=lambda: SENSORS.say(ranges()))
        topic.forget()
        until(lambda: sum(not m.connected for m in list(topic.messages)) >= 2, 'two reports')

    def test_diagnostics_are_published(self):
        topic = Topic('/diagnostics', DiagnosticArray)
        until(lambda: len(topic.messages) >= 2 * 3, 'two rounds of three links')


class WithAClock(unittest.TestCase):
    """A /clock that starts, and jumps back like a bag that is played again."""

    def test_the_age_of_a_command_is_measured_by_it(self):
        clock = rospy.Publisher('/clock', Clock, queue_size=1)
        until(lambda: clock.get_num_connections() >= 2, 'the bridge hears the clock')
        speed = command_topic('/serial_communication/speed', SpeedPWMCommand)
        rosout = Rosout()

        def say(value, stamp):
            message = SpeedPWMCommand(value=value)
            message.header.stamp = rospy.Time(stamp)
            speed.publish(message)

        def drive(value, now):
            until(lambda: value in CAR.speeds, 'speed %d' % value, every=0.1,
                  doing=lambda: (clock.publish(rospy.Time(now)), say(value, now)))

        for turn, now in enumerate((100.0, 50.0, 60.0), 1):
            CAR.forget()
            drive(turn, now)
            for _ in range(10):
                say(10 * turn, now - 1.0)
                threading.Event().wait(0.01)
                say(11 * turn, now + 40.0)
                threading.Event().wait(0.01)
            drive(100 + turn, now)
            self.assertEqual({10 * turn, 11 * turn} & set(CAR.speeds), set())
        # The bridge may log the first of them before this test has subscribed to its log.
        rosout.wait_for(PACKAGE, 'refused: its stamp is 1.00 s old',
                        doing=lambda: say(10, now - 1.0))


if __name__ == '__main__':
    rospy.init_node('simulated_time_test')
    rostest.rosrun(PACKAGE, 'simulated_time', '__main__')
