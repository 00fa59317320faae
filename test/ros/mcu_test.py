#!/usr/bin/python3
"""The mcu link: each frame's topics with their exact values, and the status of a silent board."""
import unittest
from math import inf, isinf, isnan, nan, pi, sqrt

import rospy
import rostest
from sensor_msgs.msg import Imu, Range

from boards import PACKAGE, SensorBoard, Topic, plug, ranges, stamped, until, values_of
from serial_communication.msg import McuStatus, McuStatus2
from serial_communication.boards.mcu import wire as mcu

HALF = sqrt(0.5)
SENSOR_FRAME = bytes.fromhex('020c109c2f003a0000000dfff3009803')     # SEQ 156
ADC_FRAME = bytes.fromhex('020e01ea000000000f0000001f0290006903')    # SEQ 234
GOT = 'connected', 'valid', 'seq', 'vl53_1', 'vl53_2'


def setUpModule():
    """The boards."""
    global BOARDS
    line = rospy.get_param('~line')
    plug(line, line + '_other')
    BOARDS = {'': SensorBoard(line + '_board'), '/other': SensorBoard(line + '_other_board')}


class McuTest(unittest.TestCase):
    """A board on one line; nothing is ever sent to it."""

    namespace = ''

    @classmethod
    def setUpClass(cls):
        cls.board = BOARDS[cls.namespace]
        until(lambda: cls.board.connected, 'the board has its port')

    def tearDown(self):
        self.assertEqual(bytes(self.board.wire), b'')

    def topic(self, name, message_class):
        return Topic('%s/mcu/%s' % (self.namespace, name), message_class)

    def first(self, name, message_class, frame, condition=lambda message: True):
        """Send `frame` until its message is received, and return that."""
        def send():
            self.board.write(frame if isinstance(frame, bytes) else mcu.encode(frame, 0))
        topic = self.topic(name, message_class)
        try:
            return topic.first(condition, doing=send)
        finally:
            topic.close()

    def assert_orientation(self, message, *expected):
        for value, wanted in zip(values_of(message.orientation, 'x', 'y', 'z', 'w'), expected):
            self.assertAlmostEqual(value, wanted, 6)


class Frames(McuTest):
    """With the default parameters."""

    def test_a_sensor_status_has_its_values(self):
        since = rospy.Time.now()
        status = self.first('status', McuStatus2, SENSOR_FRAME,
                            lambda m: m.connected and m.stamp >= since)
        self.assertEqual(values_of(status, *GOT), (True, True, 156, 47, 58))
        for value, wanted in zip(values_of(status, 'yaw', 'pitch', 'roll'), (0.0, -2.43, 2.43)):
            self.assertAlmostEqual(value, wanted, 5)
        self.assertTrue(stamped(status.stamp, since))
        self.assertTrue(0.0 <= status.last_frame_age_sec < 1.0)

    def test_unknown_angles_are_nan_and_no_imu_message(self):
        unknown = mcu.SensorStatus(123, 200, nan, nan, nan)
        status = self.first('status', McuStatus2, unknown, lambda m: m.vl53_1 == 123)
        imus = self.topic('imu', Imu)       # the frames of earlier tests have been received
        self.assertEqual(values_of(status, *GOT[:2]), (True, False))
        self.assertTrue(all(isnan(value) for value in values_of(status, 'yaw', 'pitch', 'roll')))
        self.first('range_1', Range, unknown, lambda m: abs(m.range - 0.123) < 1e-6)
        # The first message of the topic is of the first frame that has angles.
        turned = imus.first(doing=lambda: self.board.say(ranges(yaw=90.0)))
        self.assert_orientation(turned, 0, 0, -HALF, HALF)
        imus.close()

    def test_an_adc_status_has_its_values(self):
        since = rospy.Time.now()
        status = self.first('adc_status', McuStatus, ADC_FRAME, lambda m: m.connected)
        self.assertEqual(values_of(status, 'connected', 'valid', 'seq'), (True, True, 234))
        self.assertEqual(values_of(status, *('adc%d' % channel for channel in range(6))),
                         (0, 0, 15, 0, 543, 144))
        self.assertTrue(stamped(status.stamp, since))
        self.assertTrue(0.0 <= status.last_frame_age_sec < 1.0)

    def test_the_orientation_turns_counter_clockwise(self):
        for angles, expected in (
                ((90.0, 0.0, 0.0), (0.0, 0.0, -HALF, HALF)),
                ((0.0, 90.0, 0.0), (0.0, HALF, 0.0, HALF)),
                ((0.0, 0.0, 90.0), (HALF, 0.0, 0.0, HALF)),
                ((90.0, 0.0, 90.0), (0.5, -0.5, -0.5, 0.5)),
                ((90.0, 90.0, 0.0), (0.5, 0.5, -0.5, 0.5))):
            wanted = tuple(round(value, 3) for value in expected)
            message = self.first('imu', Imu, ranges(1, 2, *angles), lambda m, w=wanted: tuple(
                round(v, 3) + 0.0 for v in values_of(m.orientation, 'x', 'y', 'z', 'w')) == w)
            self.assert_orientation(message, *expected)

    def test_the_imu_message_marks_what_is_not_measured(self):
        message = self.first('imu', Imu, ranges())
        self.assertEqual(message.header.frame_id, 'mcu_imu')
        self.assertEqual(message.angular_velocity_covariance[0], -1.0)
        self.assertEqual(message.linear_acceleration_covariance[0], -1.0)
        for index, degrees in ((0, 1.0), (4, 1.0), (8, 5.0)):
            self.assertAlmostEqual(message.orientation_covariance[index],
                                   (degrees * pi / 180) ** 2)

    def test_each_range_follows_rep_117(self):
        for name, place in (('range_1', 0), ('range_2', 1)):
            for millimetres, expected in ((470, 0.47), (30, 0.03), (2000, 2.0), (29, -inf),
                                          (2001, inf), (0xFFFF, None)):
                def is_it(message, wanted=expected):
                    return isnan(message.range) if wanted is None else (
                        message.range == wanted if isinf(wanted)
                        else abs(message.range - wanted) < 1e-6)
                both = [1000, 1000]
                both[place] = millimetres
                message = self.first(name, Range, ranges(*both), is_it)
                self.assertEqual(message.header.frame_id, name)
                self.assertEqual(message.radiation_type, Range.INFRARED)
                self.assertAlmostEqual(message.min_range, 0.03)
                self.assertAlmostEqual(message.max_range, 2.0)
                self.assertAlmostEqual(message.field_of_view, 25 * pi / 180, 6)


class Other(McuTest):
    """Every parameter differs from its default."""

    namespace = '/other'

    def test_the_yaw_keeps_its_sign_if_the_board_counts_counter_clockwise(self):
        message = self.first('imu', Imu, ranges(1, 2, 90.0), lambda m: m.orientation.z)
        self.assert_orientation(message, 0.0, 0.0, HALF, HALF)
        self.assertEqual(message.header.frame_id, 'head')
        self.assertAlmostEqual(message.orientation_covariance[0], 0.09)
        self.assertAlmostEqual(message.orientation_covariance[8], 0.16)

    def test_the_ranges_have_the_configured_limits_and_frames(self):
        first = self.first('range_1', Range, ranges(8190, 99))
        second = self.first('range_2', Range, ranges(8190, 99), lambda m: isinf(m.range))
        self.assertAlmostEqual(first.range, 8.19, 6)
        self.assertEqual(second.range, -inf)
        self.assertEqual((first.header.frame_id, second.header.frame_id), ('front', 'rear'))
        for message in first, second:
            for name, value in (('min_range', 0.1), ('max_range', 8.5), ('field_of_view', 0.2)):
                self.assertAlmostEqual(getattr(message, name), value, 6)

    def test_the_silence_begins_after_the_configured_timeout(self):
        topic, adc = self.topic('status', McuStatus2), self.topic('adc_status', McuStatus)
        self.first('adc_status', McuStatus, ADC_FRAME, lambda m: m.connected)
        topic.first(lambda m: m.connected, doing=lambda: self.board.say(ranges()))
        self.assertGreater(topic.first(lambda m: not m.connected).last_frame_age_sec, 0.29)
        quiet = adc.first(lambda m: not m.connected)
        self.assertFalse(quiet.valid)
        self.assertEqual(values_of(quiet, *('adc%d' % n for n in range(6))), (65535,) * 6)


class Absent(unittest.TestCase):
    """A port that is absent from the start."""

    def test_the_status_is_not_connected_and_its_age_increases(self):
        topic = Topic('/absent/mcu/status', McuStatus2)
        until(lambda: len(topic.messages) >= 3, 'three reports')
        for message in topic.messages:
            self.assertEqual(values_of(message, *GOT), (False, False, 0, 65535, 65535))
            self.assertTrue(all(map(isnan, values_of(message, 'yaw', 'pitch', 'roll'))))
        ages = [message.last_frame_age_sec for message in topic.messages]
        self.assertGreater(ages[0], 0.99)
        self.assertGreater(ages[2] - ages[0], 1.5)


if __name__ == '__main__':
    rospy.init_node('mcu_test')
    rostest.rosrun(PACKAGE, 'mcu', '__main__')
