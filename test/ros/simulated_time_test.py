#!/usr/bin/python3
"""With simulated time that never starts, all periods and timeouts still work; once it starts,
stamps are compared with it."""
import struct
import threading
import time
import unittest

import rospy
import rostest
from diagnostic_msgs.msg import DiagnosticArray
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, MagneticField, Range, Temperature
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from boards import (PACKAGE, TIMEOUT, BusBoard, CarBoard, Rosout, SensorBoard, Topic,
                    again_if_stalled, command_topic, level_imu, plug, ranges, service, settle,
                    until)
from serial_communication.msg import (McuStatus2, SpeedPWMCommand, SteeringFeedback,
                                      Ticks, Voltage)
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.mcu import wire as mcu
from serial_communication.srv import GetEnvironment, Lift


def setUpModule():
    """The three boards."""
    global BUS, CAR, SENSORS
    line = rospy.get_param('~line')
    plug(line + '_bus', line + '_arduino', line + '_mcu')
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
        speed = command_topic('/serial_communication/speed', SpeedPWMCommand)
        CAR.forget()
        until(lambda: 300 in CAR.speeds, 'it drives', every=0.1,
              doing=lambda: speed.publish(value=300))
        until(lambda: CAR.speeds[-2:] == [300, 0], 'SPEED 0')

    def test_services_answer_and_time_out(self):
        lift = service('/serial_communication/lift', Lift)
        environment = service('/serial_communication/get_environment', GetEnvironment)

        def both_answer():
            settle(PACKAGE, BUS)
            return lift(0, 100).success and environment().success

        def times_out():
            settle(PACKAGE, BUS)
            BUS.script.append(b'')
            return lift(0, 100).status == TIMEOUT
        again_if_stalled(both_answer)
        again_if_stalled(times_out)
        until(lambda: service('/serial_communication/bus/echo', Trigger)().success, 'an echo')

    def test_measurements_are_published_with_a_stamp_of_0(self):
        topic = Topic('/serial_communication/imu', Imu)
        message = topic.first(doing=lambda: CAR.say(level_imu()))
        self.assertEqual(message.header.stamp, rospy.Time(0))

    def test_diagnostics_are_published(self):
        topic = Topic('/diagnostics', DiagnosticArray)
        until(lambda: len(topic.messages) >= 2 * 3, 'two rounds of three links')


class WithAClock(unittest.TestCase):
    """A /clock that starts, and jumps back like a bag that is played again."""

    def test_all_topics_have_the_stamp_of_the_measurement_also_after_a_jump(self):
        """The boards send what they have just measured, and what they measured 0.5 s ago."""
        clock = rospy.Publisher('/clock', Clock, queue_size=1)
        until(lambda: clock.get_num_connections() >= 2, 'the bridge hears the clock')
        car, sensors = [], []
        for topics, prefix, types in (
                (car, '/serial_communication/', {
                    'imu': Imu, 'imu/temperature': Temperature, 'ticks': Ticks, 'voltage': Voltage,
                    'steering_angle': SteeringFeedback, 'field': MagneticField}),
                (sensors, '/mcu/', {'imu': Imu, 'range_1': Range, 'range_2': Range,
                                    'status': McuStatus2})):
            topics += [Topic(prefix + name, kind) for name, kind in types.items()]
        tf = Topic('/tf', TFMessage)

        def say(measured):
            micros = round(measured * 1e6) % 2 ** 32
            for message in (arduino.Time(micros, 4), level_imu(), arduino.Ticks(1),
                            arduino.Voltage(12.0), arduino.SteeringAngle(500)):
                CAR.say(message)
            CAR.write(arduino.encode_raw(40, struct.pack('<Ih', micros, 5)))
            SENSORS.say(mcu.Time(micros))
            SENSORS.say(ranges())

        def say_late():
            measured = time.monotonic()
            threading.Event().wait(0.5)
            say(measured)

        def stamps(now):
            """Those of both boards that are in all of their topics, and 0.5 s before now."""
            orientations = {}
            for message in list(tf.messages):
                for each in message.transforms:
                    orientations.setdefault(each.child_frame_id, set()).add(each.header.stamp)
            common = [set.intersection(orientations.get(child, set()), *(
                {m.header.stamp if hasattr(m, 'header') else m.stamp for m in list(each.messages)}
                for each in topics)) for child, topics in (
                    ('imu_orientation', car), ('mcu_imu_orientation', sensors))]
            return all(any(0.45 < now - stamp.to_sec() < 0.95 for stamp in each)
                       for each in common)

        for now in 1000.0, 50.0:
            until(lambda: stamps(now), 'stamps of 0.5 s before %g' % now, every=0.05,
                  doing=lambda: (clock.publish(rospy.Time(now)), say(time.monotonic()),
                                 say_late()))

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
