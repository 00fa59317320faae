#!/usr/bin/python3
"""The arduino link: measurements with their exact values, commands with their exact bytes, the
heartbeat, the speed timeout, the calibration and the board's log lines."""
import subprocess
import time
import unittest
from math import nan

import rospy
import rostest
from rosgraph_msgs.msg import Log
from sensor_msgs.msg import Imu, Temperature
from std_msgs.msg import Bool, String
from std_srvs.srv import Empty

from boards import (CALIBRATION_PACKET, PACKAGE, SPEED_0_PACKET, CarBoard, Rosout, Topic,
                    command_topic, level_imu, service, stamped, until, values_of)
from serial_communication.link.outcome import Verdict
from serial_communication.msg import (SpeedPWMCommand, SteeringFeedback, SteeringPWMCommand,
                                      Ticks, Voltage)
from serial_communication.boards.arduino import wire as arduino
from serial_communication.ros.answers import read_error

# A packet of a real board; the norm of its quaternion is far from 1.
IMU_PACKET = bytes.fromhex('05092d41e00210020801040affec021e0564ff382003faf600')
XYZ = 'x', 'y', 'z'


def setUpModule():
    """Start the boards, and record the log."""
    global BOARDS, ROSOUT
    line = rospy.get_param('~line')
    BOARDS = {PACKAGE: CarBoard(line + '_board'), 'tuned': CarBoard(line + '_tuned_board')}
    ROSOUT = Rosout()


class ArduinoTest(unittest.TestCase):
    """A car on one line."""

    node = PACKAGE

    @classmethod
    def setUpClass(cls):
        cls.board = BOARDS[cls.node]
        cls.speed = command_topic('/%s/speed' % cls.node, SpeedPWMCommand)
        cls.steering = command_topic('/%s/steering' % cls.node, SteeringPWMCommand)
        cls.led = command_topic('/%s/led' % cls.node, String)
        until(lambda: cls.board.heartbeats(), 'a heartbeat')

    def setUp(self):
        self.board.forget()

    def topic(self, name, message_class):
        return Topic('/%s/%s' % (self.node, name), message_class)

    def sent(self, number):
        """The first `number` commands on the wire."""
        until(lambda: len(self.board.raw_commands) >= number, '%d commands on the wire' % number)
        return self.board.raw_commands[:number]

    def drive(self, *speeds):
        """Send each when the one before is on the wire, since only the newest may wait."""
        for number, value in enumerate(speeds, 1):
            self.speed.publish(value=value)
            self.sent(number)

    def assert_vector(self, vector, expected, places=6):
        for value, wanted in zip(values_of(vector, *XYZ), expected):
            self.assertAlmostEqual(value, wanted, places)


class Measurements(ArduinoTest):
    """With the default parameters."""

    def test_values_arrive_as_the_board_sent_them(self):
        for name, message_class, packet, value in (
                ('voltage', Voltage, '060acdcc6c4100', 14.8),
                ('ticks', Ticks, '03080700', 7),
                ('steering_angle', SteeringFeedback, '0207020200', 512)):
            since = rospy.Time.now()
            message = self.topic(name, message_class).first(
                doing=lambda p=packet: self.board.write(bytes.fromhex(p)))
            self.assertAlmostEqual(message.value, value, 5, name)
            self.assertTrue(stamped(message.header.stamp, since), name)

    def test_an_imu_packet_arrives_in_the_axes_and_units_of_ros(self):
        topic, temperature = self.topic('imu', Imu), self.topic('imu/temperature', Temperature)
        # Quaternion w x y z: 1/2 each, with signs; rates 100 200 300; 1 g along the board's x.
        packet = arduino.Imu(8192, 8192, -8192, 8192, 100, 200, 300, 8192, 4096, -8192, 3400)
        since = rospy.Time.now()
        message = topic.first(doing=lambda: self.board.say(packet))
        self.assertEqual(values_of(message.orientation, 'x', 'y', 'z', 'w'),
                         (-0.5, -0.5, 0.5, 0.5))
        self.assert_vector(message.angular_velocity, (5.326322, -2.663161, 7.989483))
        self.assert_vector(message.linear_acceleration, (4.905, -9.81, -9.81))
        self.assertEqual(message.header.frame_id, 'imu')
        self.assertTrue(stamped(message.header.stamp, since))
        warm = temperature.first(doing=lambda: self.board.say(packet))
        self.assertAlmostEqual(warm.temperature, 46.53)
        self.assertEqual(warm.header.frame_id, 'imu')

    def test_the_imu_has_its_covariances(self):
        message = self.topic('imu', Imu).first(doing=lambda: self.board.say(level_imu()))
        self.assert_diagonal(message.linear_acceleration_covariance, [1.538836e-05] * 3)
        self.assert_diagonal(message.angular_velocity_covariance, [7.615435e-07] * 3)
        self.assert_diagonal(message.orientation_covariance,
                             [3.046174e-04, 3.046174e-04, 7.615435e-03])

    def assert_diagonal(self, matrix, expected):
        self.assertEqual([matrix[index] for index in (1, 2, 3, 5, 6, 7)], [0.0] * 6)
        for value, wanted in zip(matrix[::4], expected):
            self.assertAlmostEqual(value / wanted, 1.0, 5)

    def test_implausible_values_are_dropped(self):
        topics = [self.topic('voltage', Voltage), self.topic('steering_angle', SteeringFeedback),
                  self.topic('imu', Imu)]
        good = [arduino.Voltage(12.0), arduino.SteeringAngle(1024), level_imu()]
        for topic, message in zip(topics, good):
            topic.first(doing=lambda m=message: self.board.say(m))
            topic.forget()
        bad = [arduino.Voltage(value) for value in (nan, float('inf'), -1.0, 101.0)] + [
            arduino.SteeringAngle(1025), arduino.SteeringAngle(65535),
            level_imu()._replace(qw=0), level_imu()._replace(qw=15000),
            level_imu()._replace(qx=16384)]
        for message in bad:
            self.board.say(message)
        self.board.write(IMU_PACKET)
        self.board.say(arduino.Voltage(100.0))
        self.board.say(arduino.SteeringAngle(0))
        self.board.say(level_imu()._replace(qw=16000))
        # Each topic has its own connection, so each has to be waited for.
        topics[0].first(lambda m: m.value == 100.0)
        topics[1].first(lambda m: m.value == 0)
        self.assertEqual(topics[2].first(lambda m: m.orientation.w < 1).orientation.w,
                         16000 / 16384)
        # A few of the valid messages before may have arrived late.
        self.assertTrue({m.value for m in topics[0].messages} <= {12.0, 100.0})
        self.assertTrue({m.value for m in topics[1].messages} <= {1024, 0})
        self.assertTrue({m.orientation.w for m in topics[2].messages} <= {1.0, 16000 / 16384})

    def test_wrong_lengths_and_unknown_types_are_dropped(self):
        topic = self.topic('ticks', Ticks)
        topic.first(doing=lambda: self.board.say(arduino.Ticks(1)))
        for type_, data in ((8, b''), (8, b'\x02\x03'), (99, b'\x04'), (8, b'\x05')):
            self.board.write(arduino.encode_raw(type_, data))
        topic.first(lambda m: m.value == 5)
        values = [m.value for m in topic.messages]
        self.assertTrue(set(values[values.index(1):]) <= {1, 5}, values)


class Commands(ArduinoTest):
    """Commands for speed, steering and LED, and the heartbeat."""

    def test_commands_have_their_exact_bytes(self):
        self.drive(400, -1000, 0)
        self.assertEqual(self.sent(3), [bytes.fromhex('0404900100'), bytes.fromhex('040418fc00'),
                                        SPEED_0_PACKET])
        self.board.forget()
        self.steering.publish(value=1500)
        self.assertEqual(self.sent(1), [bytes.fromhex('0405dc0500')])
        self.board.forget()
        self.led.publish('left')
        self.assertEqual(self.sent(1), [bytes.fromhex('06066c6566740100')])

    def test_speed_is_saturated_with_one_warning(self):
        self.drive(1001, 32767, -1001, -32768, 0)
        self.assertEqual(self.sent(5), [bytes.fromhex('0404e80300')] * 2
                         + [bytes.fromhex('040418fc00')] * 2 + [SPEED_0_PACKET])
        ROSOUT.wait_for(self.node, 'speed 1001 is out of range (-1000 … 1000), sent 1000', Log.WARN)
        self.assertEqual(len(ROSOUT.lines(self.node, 'is out of range')), 1)

    def test_heartbeats_are_sent_a_hundred_times_a_second(self):
        self.board.wait_for_heartbeat_rate(40, 130)

    def test_a_speed_that_is_not_renewed_ends_in_one_speed_0(self):
        published = []      # the bridge cannot receive it earlier

        def publish():      # again, if the machine stalled the bridge, which then refuses it
            if not published or time.monotonic() > published[-1] + 2.0:
                published.append(time.monotonic())
                self.speed.publish(value=300)
        until(lambda: self.board.raw_commands, 'the speed is sent', doing=publish)
        self.sent(2)
        command, end = self.board.command_frames
        self.assertEqual(end.raw, SPEED_0_PACKET)
        self.assertGreater(end.stamp - published[-1], 0.5)
        # The bridge's own clock: it sends 100 heartbeats in a second.
        between = [at for at in self.board.heartbeat_times if command.stamp < at < end.stamp]
        self.assertLess(len(between), 200)
        ROSOUT.wait_for(self.node, 'no speed command for 0.5 s', Log.WARN)
        self.board.wait_for_heartbeats(80)
        self.assertEqual(self.board.speeds, [300, 0])

    def test_a_commanded_speed_0_is_repeated_for_a_second(self):
        def stops():
            self.board.forget()
            self.drive(300, 0)
            self.board.wait_for_heartbeats(130)
            self.assertEqual(self.board.speeds, [300, 0])
            return len(self.speed_0_frames())
        # After a stall of the bridge a stop begins anew.
        self.assertTrue(any(10 <= stops() <= 21 for _ in range(3)))
        self.board.forget()
        self.board.wait_for_heartbeats(30)
        self.assertEqual(self.speed_0_frames(), [])

    def speed_0_frames(self):
        return [frame for frame in self.board.frames if frame.raw == SPEED_0_PACKET]

    def test_a_speed_that_is_renewed_is_kept(self):
        until(lambda: len(self.board.raw_commands) > 12, 'a dozen commands', every=0.1,
              doing=lambda: self.speed.publish(value=100))
        commands = self.board.command_frames
        for before, after in zip(commands, commands[1:]):
            self.assertTrue(after.message.value == 100 or after.stamp - before.stamp > 0.45)
        self.speed.publish(value=0)
        until(lambda: self.board.speeds[-1] == 0, 'the end')


class Calibration(ArduinoTest):
    """calibrate_imu, and the commands that it blocks."""

    def test_a_calibration_stops_the_car_and_blocks_commands_until_it_ends(self):
        topic = self.topic('imu/calibrating', Bool)
        self.assertFalse(topic.first().data)         # latched
        self.speed.publish(value=200)
        self.sent(1)
        service('/serial_communication/calibrate_imu', Empty)()
        self.assertEqual(self.sent(3), [bytes.fromhex('0304c80100'), SPEED_0_PACKET,
                                        CALIBRATION_PACKET])
        topic.first(lambda m: m.data)
        late = self.topic('imu/calibrating', Bool)
        self.assertTrue(late.first().data)

        self.speed.publish(value=500)
        self.steering.publish(value=1000)
        self.led.publish('brake')
        for command in ('speed 500', 'steering 1000', 'LED brake'):
            ROSOUT.wait_for(self.node, command + ' refused: the board calibrates its IMU',
                            Log.WARN)
        self.board.say(arduino.Voltage(12.0))        # no IMU data: goes on
        self.assertEqual([m.data for m in late.messages], [True])

        # IMU data ends it only after a silence: data already on its way does not.
        until(lambda: not late.messages[-1].data, 'the calibration is over',
              doing=lambda: self.board.say(level_imu()), every=2.5)
        self.assertEqual(len(self.board.raw_commands), 3)
        self.steering.publish(value=1234)
        self.assertEqual(self.sent(4)[3], bytes.fromhex('0405d20400'))
        self.assertEqual(self.board.speeds, [200, 0])

    def test_calibrate_imu_is_a_service_error_if_the_port_is_closed(self):
        with self.assertRaises(rospy.ServiceException) as caught:
            service('/closed/calibrate_imu', Empty)()
        self.assertRegex(str(caught.exception), r'status 253 \(not sent\): .* closed')
        self.assertIs(read_error(caught.exception)[0], Verdict.REFUSED)


class Logs(ArduinoTest):
    """The board's log lines."""

    def test_log_lines_of_the_board_keep_their_severity(self):
        for severity, level in enumerate((Log.INFO, Log.WARN, Log.ERROR), 1):
            text = 'a line of severity %d' % severity
            self.board.say(arduino.Log(severity, text))
            ROSOUT.wait_for(self.node, text, level)

    def test_debug_lines_of_the_board_are_logged_once_the_service_asks_for_them(self):
        self.board.say(arduino.Log(0, 'a line that nobody asked for'))
        self.board.say(arduino.Log(1, 'the line after it'))
        ROSOUT.wait_for(self.node, 'the line after it', Log.INFO)
        self.assertEqual(ROSOUT.lines(self.node, 'a line that nobody asked for'), [])
        for level in 'DEBUG', 'INFO':
            subprocess.run(['rosservice', 'call', '/serial_communication/set_logger_level',
                            'rosout', level], check=True, stdout=subprocess.DEVNULL)
            if level == 'DEBUG':
                self.board.say(arduino.Log(0, 'a line that was asked for'))
                ROSOUT.wait_for(self.node, 'a line that was asked for', Log.DEBUG)

    def test_the_zero_byte_that_ends_a_log_line_is_removed(self):
        self.board.write(bytes.fromhex('0c01444d50207265616479210100'))
        line = ROSOUT.wait_for(self.node, 'DMP ready!', Log.INFO)
        self.assertTrue(line.endswith('DMP ready!'), line)

    def test_control_characters_and_invalid_utf_8_are_replaced(self):
        self.board.write(arduino.encode_raw(2, b'odd \x1b[31m\xff\xfe at its tail\x00'))
        line = ROSOUT.wait_for(self.node, 'at its tail', Log.WARN)
        self.assertTrue(line.isprintable(), line)
        self.assertIn('odd', line)


class Tuned(ArduinoTest):
    """Every parameter differs from its default."""

    node = 'tuned'

    def test_an_imu_packet_is_published_unchecked_with_the_configured_parameters(self):
        topic, temperature = self.topic('imu', Imu), self.topic('imu/temperature', Temperature)
        message = topic.first(doing=lambda: self.board.write(IMU_PACKET))
        self.assertEqual(values_of(message.orientation, 'x', 'y', 'z', 'w'),
                         (0.25, 0.5, 0.125, 0.70709228515625))
        self.assert_vector(message.angular_velocity, (-0.020, -0.010, 0.030))
        self.assert_vector(message.linear_acceleration, (-0.239501953125, -0.1197509765625,
                                                         9.81))
        self.assertEqual(message.header.frame_id, 'car_imu')
        for matrix, wanted in ((message.linear_acceleration_covariance, (0.01, 0.01, 0.01)),
                               (message.angular_velocity_covariance, (0.04, 0.04, 0.04)),
                               (message.orientation_covariance, (0.09, 0.09, 0.16))):
            for value, right in zip(matrix[::4], wanted):
                self.assertAlmostEqual(value, right)
        warm = temperature.first(doing=lambda: self.board.write(IMU_PACKET))
        self.assertAlmostEqual(warm.temperature, 32.735882352941175)
        self.assertEqual(warm.header.frame_id, 'car_imu')

    def test_an_implausible_voltage_is_published_unchecked(self):
        self.assertEqual(self.topic('voltage', Voltage).first(
            doing=lambda: self.board.say(arduino.Voltage(250.0))).value, 250.0)

    def test_the_heartbeat_has_the_configured_rate(self):
        self.board.wait_for_heartbeat_rate(10, 50, number=40)

    def test_a_speed_timeout_of_0_never_stops_the_motor(self):
        self.speed.publish(value=300)
        self.sent(1)
        self.board.wait_for_heartbeats(40)      # a second
        self.assertEqual(self.board.speeds, [300])
        self.speed.publish(value=0)
        self.sent(2)

    def test_led_texts_that_the_board_cannot_take_are_refused_with_a_warning(self):
        self.led.publish('x' * 31)
        ROSOUT.wait_for(self.node, '31 characters', Log.WARN)
        self.led.publish('bräke')
        ROSOUT.wait_for(self.node, 'must be ASCII', Log.WARN)      # for another reason: said, too
        self.led.publish('x' * 30)
        self.assertEqual(self.sent(1), [b'\x20\x06' + b'x' * 30 + b'\x01\x00'])
        self.board.wait_for_heartbeats(3)
        self.assertEqual(len(self.board.raw_commands), 1)


if __name__ == '__main__':
    rospy.init_node('arduino_test')
    rostest.rosrun(PACKAGE, 'arduino', '__main__')
