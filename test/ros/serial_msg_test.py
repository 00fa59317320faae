#!/usr/bin/python3
"""serial_msg: every frame of every link, received and sent, valid and invalid."""
import unittest

import rospy
import rostest

from boards import (HEARTBEAT_PACKET, PACKAGE, RX, TX, BusBoard, CarBoard, SensorBoard, Topic,
                    command_topic, service, settle, stamped, until, values_of)
from serial_communication.msg import SerialMsg, SpeedPWMCommand
from serial_communication.srv import BusRequest, Lift

FIELDS = 'type', 'command', 'data', 'frame', 'error'


def setUpModule():
    """The three boards."""
    global BUS, CAR, SENSORS
    line = rospy.get_param('~line')
    BUS, CAR, SENSORS = (BusBoard(line + '_bus_board'), CarBoard(line + '_arduino_board'),
                         SensorBoard(line + '_mcu_board'))


class SerialMsgTest(unittest.TestCase):
    """Three boards, and a subscriber of serial_msg."""

    def setUp(self):
        settle(PACKAGE, BUS)
        until(lambda: CAR.heartbeats() and SENSORS.connected, 'the other boards are there')
        self.since = rospy.Time.now()
        self.topic = Topic('/serial_msg', SerialMsg)
        self.topic.first(lambda m: m.link == 'arduino')    # the bridge has the subscriber

    def tearDown(self):
        self.topic.close()

    def first_frame(self, link, direction, condition=lambda message: True):
        """Wait for a frame of a link in one direction, and return the first."""
        return self.topic.first(lambda m: (m.link, m.direction) == (link, direction)
                                and condition(m), what='%s %d' % (link, direction))

    def assert_frame(self, message, type_, command, data, frame, words):
        self.assertEqual(values_of(message, *FIELDS), (
            type_, command, bytes.fromhex(data), bytes.fromhex(frame), ''))
        self.assert_text(message, words)

    def assert_bad(self, message, frame, cause):
        self.assertEqual(message.frame, bytes.fromhex(frame))
        self.assertIn(cause, message.error)
        self.assert_text(message, '')

    def assert_text(self, message, words):
        self.assertIn(words, message.text)
        self.assertTrue(message.text.strip())
        self.assertNotIn('\n', message.text + message.error)
        self.assertTrue(stamped(message.header.stamp, self.since))

    def test_bus_frames_are_published_in_both_directions(self):
        """An ECHO may be sent and received before them."""
        service('/serial_communication/lift', Lift)(0, 100)
        self.assert_frame(self.first_frame('bus', TX, lambda m: m.type != 0x01), 0x55, 0x20, '0064',
                          'a50255200064b6', 'lift up 100 mm')
        self.assert_frame(self.first_frame('bus', RX, lambda m: m.type != 0x01), 0x02, 0, '',
                          'a50002a7', 'OK')

    def test_a_long_bus_frame_is_published(self):
        data = bytes(300)
        service('/serial_communication/bus/request', BusRequest)(0x01, 0, data)
        for direction in TX, RX:
            message = self.first_frame('bus', direction, lambda m: len(m.data) > 4)
            self.assertEqual(values_of(message, 'type', 'command', 'data', 'error'),
                             (0x01, 0, data, ''))
            self.assertEqual(message.frame[:3], b'\x5a\x2c\x01')

    def test_an_invalid_bus_frame_is_published_with_its_error(self):
        BUS.write(bytes.fromhex('a50002a6'))
        self.assert_bad(self.first_frame('bus', RX, lambda m: m.error), 'a50002a6', 'checksum')

    def test_arduino_packets_are_published_in_both_directions(self):
        command_topic('/serial_communication/speed', SpeedPWMCommand).publish(value=-1000)
        # SPEED 0 may still be repeated, since the port was just opened.
        speed = self.first_frame('arduino', TX, lambda m: m.type == 4 and any(m.data))
        self.assert_frame(speed, 4, 0, '18fc', '040418fc00', 'speed -1000')
        self.assert_frame(self.first_frame('arduino', TX, lambda m: m.frame == HEARTBEAT_PACKET),
                          11, 0, '', '020b00', 'heartbeat')
        CAR.write(bytes.fromhex('060acdcc6c4100'))
        self.assert_frame(self.first_frame('arduino', RX), 10, 0, 'cdcc6c41', '060acdcc6c4100',
                          '14.8')

    def test_invalid_arduino_packets_are_published_with_their_errors(self):
        for packet, cause in (('ff010200', 'framing'), ('0408010200', 'length'),
                              ('026300', 'unknown type'), ('0407ffff00', 'implausible')):
            self.topic.forget()
            CAR.write(bytes.fromhex(packet))
            self.assert_bad(self.first_frame('arduino', RX), packet, cause)

    def test_mcu_frames_are_published(self):
        SENSORS.write(bytes.fromhex('020c109c2f003a0000000dfff3009803'))
        self.assert_frame(self.first_frame('mcu', RX), 0x10, 156, '2f003a0000000dfff300',
                          '020c109c2f003a0000000dfff3009803', '47 mm')
        self.topic.forget()
        SENSORS.write(bytes.fromhex('020e01ea000000000f0000001f0290006903'))
        self.assert_frame(self.first_frame('mcu', RX), 0x01, 234, '000000000f0000001f029000',
                          '020e01ea000000000f0000001f0290006903', '543')

    def test_a_later_subscriber_gets_frames_again(self):
        self.topic.close()
        self.topic = Topic('/serial_msg', SerialMsg)
        self.first_frame('arduino', TX)


if __name__ == '__main__':
    rospy.init_node('serial_msg_test')
    rostest.rosrun(PACKAGE, 'serial_msg', '__main__')
