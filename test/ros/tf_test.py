#!/usr/bin/python3
"""tf: the sensors' mounts, and with publish_tf their orientations."""
import unittest
from math import sqrt

import rospy
import rostest
from sensor_msgs.msg import Imu, Range, Temperature
from tf2_msgs.msg import TFMessage

from boards import (PACKAGE, CarBoard, SensorBoard, Topic, plug, ranges, stamped, until,
                    values_of)
from serial_communication.boards.arduino import wire as arduino

HALF = sqrt(0.5)


def setUpModule():
    """The boards of three bridges."""
    global CAR, SENSORS, STILL, PREFIXED_CAR, PREFIXED_SENSORS
    line = rospy.get_param('~line')
    plug(line + '_arduino', line + '_mcu', line + '_still', line + '_prefixed_arduino',
         line + '_prefixed_mcu')
    CAR, SENSORS = CarBoard(line + '_arduino_board'), SensorBoard(line + '_mcu_board')
    STILL = CarBoard(line + '_still_board')
    PREFIXED_CAR = CarBoard(line + '_prefixed_arduino_board')
    PREFIXED_SENSORS = SensorBoard(line + '_prefixed_mcu_board')


class TfTest(unittest.TestCase):
    """The transforms on /tf and /tf_static, by node."""

    def transform(self, topic, node, child, doing=None, near=None):
        """Wait for a transform of `child` by `node`; with `rotation`, for one near it, since
        messages of the previous test may still be on their way."""
        def fits(transform):
            return transform.child_frame_id == child and (near is None or all(
                abs(got - wanted) < 0.1 for got, wanted in zip(
                    values_of(transform.transform.rotation, 'x', 'y', 'z', 'w'), near)))

        def find():
            return [t for m in list(topic.messages) if m._connection_header['callerid'] == node
                    for t in m.transforms if fits(t)]
        return until(find, '%s of %s' % (child, node), doing=doing, every=0.02)[-1]

    def assert_transform(self, found, parent, translation, rotation):
        self.assertEqual(found.header.frame_id, parent)
        for got, wanted in ((values_of(found.transform.translation, 'x', 'y', 'z'), translation),
                            (values_of(found.transform.rotation, 'x', 'y', 'z', 'w'),
                             rotation)):
            for value, right in zip(got, wanted):
                self.assertAlmostEqual(value, right, 6)

    def test_the_mounts_have_the_configured_positions(self):
        topic = Topic('/tf_static', TFMessage)
        for child, translation, rotation in (
                ('car_imu', (0.1, -0.2, 0.3), (0, 0, HALF, HALF)),
                ('head', (0, 0, 1), (1, 0, 0, 0)),
                ('front', (0.5, 0, 0), (0, HALF, 0, HALF)),
                ('range_2', (-0.5, 0, 0), (0.5, 0.5, 0.5, 0.5))):
            self.assert_transform(self.transform(topic, '/moving', child), 'trunk',
                                  translation, rotation)

    def test_by_default_only_links_with_a_port_have_mounts(self):
        topic = Topic('/tf_static', TFMessage)
        self.assert_transform(self.transform(topic, '/still', 'imu'), 'base_link', (0, 0, 0),
                              (0, 0, 0, 1))
        self.assertEqual({t.child_frame_id for m in topic.messages for t in m.transforms
                          if m._connection_header['callerid'] == '/still'}, {'imu'})

    def test_the_measured_orientations_are_children_of_their_sensors(self):
        topic = Topic('/tf', TFMessage)
        packet = arduino.Imu(8192, 8192, -8192, 8192, 0, 0, 0, 0, 0, 8192, 0)
        since = rospy.Time.now()
        turned = (-0.5, -0.5, 0.5, 0.5)
        found = self.transform(topic, '/moving', 'car_attitude', lambda: CAR.say(packet), turned)
        self.assert_transform(found, 'car_imu', (0, 0, 0), turned)
        self.assertTrue(stamped(found.header.stamp, since))
        found = self.transform(topic, '/moving', 'head_attitude',
                               lambda: SENSORS.say(ranges(yaw=90.0)), (0, 0, -HALF, HALF))
        self.assert_transform(found, 'head', (0, 0, 0), (0, 0, -HALF, HALF))

    def test_a_quaternion_is_normalised_for_tf2(self):
        topic = Topic('/tf', TFMessage)
        packet = arduino.Imu(16000, 0, 0, 0, 0, 0, 0, 0, 0, 8192, 0)      # norm 0.977
        found = self.transform(topic, '/moving', 'car_attitude', lambda: CAR.say(packet),
                               (0, 0, 0, 1))
        self.assert_transform(found, 'car_imu', (0, 0, 0), (0, 0, 0, 1))

    def test_every_frame_id_has_the_prefix(self):
        mounts, turned = Topic('/tf_static', TFMessage), Topic('/tf', TFMessage)
        node = '/robot/prefixed'
        for child in 'imu', 'mcu_imu', 'range_1', 'range_2':
            found = self.transform(mounts, node, 'robot/' + child)
            self.assertEqual(found.header.frame_id, 'robot/base_link')
        packet = arduino.Imu(16384, 0, 0, 0, 0, 0, 0, 0, 0, 8192, 0)
        for child, doing in (('imu', lambda: PREFIXED_CAR.say(packet)),
                             ('mcu_imu', lambda: PREFIXED_SENSORS.say(ranges()))):
            found = self.transform(turned, node, 'robot/%s_orientation' % child, doing)
            self.assertEqual(found.header.frame_id, 'robot/' + child)
        for name, message_class, frame, doing in (
                ('prefixed/imu', Imu, 'imu', lambda: PREFIXED_CAR.say(packet)),
                ('prefixed/imu/temperature', Temperature, 'imu',
                 lambda: PREFIXED_CAR.say(packet)),
                ('mcu/imu', Imu, 'mcu_imu', lambda: PREFIXED_SENSORS.say(ranges())),
                ('mcu/range_1', Range, 'range_1', lambda: PREFIXED_SENSORS.say(ranges())),
                ('mcu/range_2', Range, 'range_2', lambda: PREFIXED_SENSORS.say(ranges()))):
            message = Topic('/robot/' + name, message_class).first(doing=doing)
            self.assertEqual(message.header.frame_id, 'robot/' + frame)

    def test_without_publish_tf_no_orientation_is_published(self):
        topic = Topic('/tf', TFMessage)
        imu = Topic('/still/imu', Imu)
        packet = arduino.Imu(16384, 0, 0, 0, 0, 0, 0, 0, 0, 8192, 0)
        imu.first(doing=lambda: STILL.say(packet))
        self.transform(topic, '/moving', 'car_attitude', lambda: CAR.say(packet))
        self.assertEqual({m._connection_header['callerid'] for m in topic.messages}, {'/moving'})


if __name__ == '__main__':
    rospy.init_node('tf_test')
    rostest.rosrun(PACKAGE, 'tf', '__main__')
