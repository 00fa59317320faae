#!/usr/bin/python3
"""The arduino link: measurements with their exact values, commands with their exact bytes, the
heartbeat, the speed timeout, the calibration and the board's log lines."""
import unittest

import rospy
import rostest
from rosgraph_msgs.msg import Log
from sensor_msgs.msg import Imu, Temperature
from std_msgs.msg import Bool, String
from std_srvs.srv import Empty

from boards import (CALIBRATION_PACKET, PACKAGE, SPEED_0_PACKET, CarBoard, Diagnostics, Rosout,
                    Topic, again_if_stalled, calibrates, command_topic, level_imu, plug, service,
                    stamped, until, values_of)
from serial_communication.simulation.announcing import chunks_of
from serial_communication.msg import (SpeedPWMCommand, SteeringFeedback, SteeringPWMCommand,
                                      Ticks, Voltage)
from serial_communication.boards.arduino import wire as arduino
from serial_communication.tools.watch.calls import Verdict, read_error

# A packet of a real board; the norm of its quaternion is far from 1.
IMU_PACKET = bytes.fromhex('05092d41e00210020801040affec021e0564ff382003faf600')
XYZ = 'x', 'y', 'z'


def setUpModule():
    """Start the boards, and record the log."""
    global BOARDS, ROSOUT
    line = rospy.get_param('~line')
    plug(line, line + '_tuned')
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

    def arrives(self, topic, message):
        """Publish a command; False if a stall of this machine kept it back: it is not on the wire
        after 200 heartbeats."""
        number, beats = len(self.board.raw_commands) + 1, self.board.heartbeats() + 200
        topic.publish(message)
        until(lambda: len(self.board.raw_commands) >= number or self.board.heartbeats() > beats,
              'a command or heartbeats on the wire')
        return len(self.board.raw_commands) >= number

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


class Commands(ArduinoTest):
    """Commands for speed, steering and LED, and the heartbeat."""

    def test_commands_have_their_exact_bytes(self):
        speeds = [(self.speed, SpeedPWMCommand(value=value)) for value in (400, -1000, 0)]
        for commands, packets in (
                (speeds, [bytes.fromhex('0404900100'), bytes.fromhex('040418fc00'),
                          SPEED_0_PACKET]),
                ([(self.steering, SteeringPWMCommand(value=1500))], [bytes.fromhex('0405dc0500')]),
                ([(self.led, String('left'))], [bytes.fromhex('06066c6566740100')])):
            def sends_them(commands=commands, packets=packets):
                self.board.forget()
                # Each when the one before is on the wire, since only the newest may wait.
                arrived = all([self.arrives(*command) for command in commands])
                print(self.board.raw_commands)
                return arrived and self.board.raw_commands == packets
            again_if_stalled(sends_them)


class Calibration(ArduinoTest):
    """calibrate_imu, and the commands that it blocks."""

    def test_a_calibration_stops_the_car_and_blocks_commands_until_it_ends(self):
        topic = self.topic('imu/calibrating', Bool)
        self.assertFalse(topic.first().data)         # latched
        again_if_stalled(lambda: self.arrives(self.speed, SpeedPWMCommand(value=200)))
        until(calibrates, 'the board calibrates its IMU', every=0.2)
        self.assertEqual(self.sent(3), [bytes.fromhex('0304c80100'), SPEED_0_PACKET,
                                        CALIBRATION_PACKET])
        topic.first(lambda m: m.data)
        late = self.topic('imu/calibrating', Bool)
        self.assertTrue(late.first().data)

        self.speed.publish(value=500)
        self.steering.publish(value=1000)
        self.led.publish('brake')
        for command in ('speed 500', 'steering 1000', "LED 'brake'"):
            ROSOUT.wait_for(self.node, command + ' refused: the board calibrates its IMU',
                            Log.WARN)
        self.board.say(arduino.Voltage(12.0))        # no IMU data: goes on
        self.assertEqual([m.data for m in late.messages], [True])

        # IMU data ends it only after a silence: data already on its way does not.
        until(lambda: not late.messages[-1].data, 'the calibration is over',
              doing=lambda: self.board.say(level_imu()), every=2.5)
        self.assertEqual(len(self.board.raw_commands), 3)
        until(lambda: len(self.board.raw_commands) > 3, 'commands are sent again', every=0.1,
              doing=lambda: self.steering.publish(value=1234))
        self.assertEqual(self.sent(4)[3], bytes.fromhex('0405d20400'))
        self.assertEqual(self.board.speeds, [200, 0])

    def test_calibrate_imu_is_a_service_error_if_the_port_is_closed(self):
        def says_that_it_is_closed():       # or that it may have waited during a stall
            with self.assertRaises(rospy.ServiceException) as caught:
                service('/closed/calibrate_imu', Empty)()
            self.assertIs(read_error(caught.exception)[0], Verdict.FAILED)
            return 'closed' in str(caught.exception)
        until(says_that_it_is_closed, 'the error says that the port is closed', every=0.2)


class Logs(ArduinoTest):
    """The board's log lines."""

    def test_log_lines_of_the_board_keep_their_severity(self):
        for severity, level in enumerate((Log.INFO, Log.WARN, Log.ERROR), 1):
            text = 'a line of severity %d' % severity
            message = arduino.LOGS[severity](text)
            ROSOUT.wait_for(self.node, text, level, lambda m=message: self.board.say(m))


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

    def test_an_announcement_is_ignored(self):
        diagnostics = Diagnostics(self.node)
        self.addCleanup(diagnostics.close)
        row = b'force: {type: 32, ros_type: std_msgs/Float32, layout: "<h", fields: [data]}'
        messages = [*chunks_of(row, 20), arduino.LOGS[1]('the line after it')]
        ROSOUT.wait_for(self.node, 'the line after it',
                        doing=lambda: [self.board.say(message) for message in messages])
        diagnostics.fresh('arduino', lambda status: 'announced' not in status.keys
                          and status.keys['unknown type errors'] == '0', 'no announcement')
        self.assertNotIn('/tuned/force', [name for name, _ in rospy.get_published_topics()])

    def test_the_heartbeat_has_the_configured_rate(self):
        self.board.wait_for_heartbeat_rate(10, 50, number=40)


if __name__ == '__main__':
    rospy.init_node('arduino_test')
    rostest.rosrun(PACKAGE, 'arduino', '__main__')
