#!/usr/bin/python3
"""The bus link: every service, its exact bytes, and its answers."""
import re
import time
import unittest

import rospy
import rostest
from sensor_msgs.msg import RelativeHumidity, Temperature
from std_srvs.srv import Trigger

from boards import (AIR, NOT_SENT, PACKAGE, SYNC_FRAME, TIMEOUT, BusBoard, Topic, Waiter,
                    again_if_stalled, plug, service, settle, stamped, until)
from serial_communication.msg import Environment
from serial_communication.boards.bus import wire as bus
from serial_communication.srv import (BusRequest, GetEnvironment, Gimbal,
                                      GimbalRequest, Lift, LiftRequest)

ENVIRONMENT = bytes.fromhex('a5025522d0')


def setUpModule():
    """The boards of the nodes."""
    global BOARDS
    line = rospy.get_param('~line')
    plug(line)
    BOARDS = {PACKAGE: BusBoard(line + '_board')}


class BusTest(unittest.TestCase):
    """One board at the end of one line."""

    node = PACKAGE
    polled = False      # whether the board gets requests for the environment at any time

    @classmethod
    def setUpClass(cls):
        cls.board = BOARDS[cls.node]
        for name, service_class in (
                ('lift', Lift), ('gimbal', Gimbal), ('get_environment', GetEnvironment),
                ('bus/request', BusRequest), ('bus/echo', Trigger), ('bus/sync', Trigger)):
            setattr(cls, name.split('/')[-1], service('/%s/%s' % (cls.node, name),
                                                      service_class))

    def setUp(self):
        settle(self.node, self.board)

    def answered(self, *calls, script=()):
        """The answers to these calls, one after the other, for which the board has this script.

        All are made again if a stall of this machine kept one back or dropped a reply.
        """
        def all_answered():
            settle(self.node, self.board)
            self.board.script += script
            answers = [call(*arguments) for call, *arguments in calls]
            if any(answer.status in (NOT_SENT, TIMEOUT) for answer in answers):
                return None
            # What is repeatable is sent again after a reply that was dropped.
            return answers if self.polled or len(self.sent()) == len(calls) else None
        return again_if_stalled(all_answered)

    def sent(self):
        """The frames on the wire, apart from the ECHOs that are fences."""
        return [frame.raw for frame in list(self.board.frames) if frame.type != bus.ECHO]

    def assert_answer(self, answer, success, status, error_code=0):
        self.assertEqual((answer.success, answer.status, answer.error_code),
                         (success, status, error_code), answer.message)
        self.assertTrue(answer.message.strip())
        self.assertNotIn('\n', answer.message)

    def assert_wire(self, *expected):
        """These are the exact bytes on the wire, apart from the ECHOs that are fences."""
        self.assertEqual(self.sent(), list(expected))
        until(lambda: bytes(self.board.wire) == b''.join(self.board.raws), 'only frames are sent')


class Moves(BusTest):
    """Lift and gimbal; test/boards/bus has the tests of all replies."""

    def test_lift_and_gimbal_requests_have_their_exact_bytes(self):
        for answer in self.answered(
                (self.lift, LiftRequest.UP, 100), (self.lift, LiftRequest.DOWN, 255),
                *((self.gimbal, direction, 90) for direction in (
                    GimbalRequest.LEFT, GimbalRequest.RIGHT, GimbalRequest.UP,
                    GimbalRequest.DOWN))):
            self.assert_answer(answer, True, bus.OK)
        self.assert_wire(*[bytes.fromhex(frame) for frame in (
            'a50255200064b6', 'a502552001ff2c', 'a5025521005a89', 'a5025521015a88',
            'a5025521025a8b', 'a5025521035a8a')])


class Air(BusTest):
    """Environment readings."""

    def setUp(self):
        super().setUp()
        self.board.air = AIR

    def test_a_fresh_reading_has_its_values_and_exact_bytes(self):
        began = rospy.Time.now()
        answer, = self.answered((self.get_environment,))
        self.assert_answer(answer, True, bus.OK)
        self.assert_wire(ENVIRONMENT)
        reading = answer.environment
        self.assertEqual(reading.smoke, 350)
        self.assertAlmostEqual(reading.temperature, 25.63, 5)
        self.assertAlmostEqual(reading.humidity, 48.12, 5)
        self.assertTrue(stamped(reading.header.stamp, began))

    def test_a_reading_is_published_in_the_units_of_each_topic(self):
        raw = Topic('/serial_communication/environment', Environment)
        temperature = Topic('/serial_communication/environment/temperature', Temperature)
        humidity = Topic('/serial_communication/environment/humidity', RelativeHumidity)
        self.board.air = bus.Environment(65535, -12.5, 48.12)
        answers = []
        message = raw.first(doing=lambda: answers.append(self.get_environment()))
        self.assertIn(message.header.stamp, [answer.environment.header.stamp
                                             for answer in answers])     # of the read
        self.assertEqual(message.smoke, 65535)
        self.assertAlmostEqual(message.temperature, -12.5, 5)
        self.assertAlmostEqual(message.humidity, 48.12, 5)
        self.assertEqual(message.header.frame_id, 'base_link')
        self.assertAlmostEqual(temperature.first(doing=self.get_environment).temperature, -12.5)
        self.assertAlmostEqual(
            humidity.first(doing=self.get_environment).relative_humidity, 0.4812)
        self.board.air = bus.Environment(0, 0.0, 100.0)
        self.assertEqual(humidity.next(lambda m: m.relative_humidity > 0.5,
                                       doing=self.get_environment).relative_humidity, 1.0)


class Raw(BusTest):
    """bus/request, bus/echo, bus/sync."""

    def test_a_raw_request_carries_data_both_ways(self):
        answer, unsupported = self.answered(
            (self.request, 0x55, 0x30, b'\x07'), (self.request, 0x0F, 0x00, b''),
            script=(bus.Reply(bus.OK, b'\x01\x02\x03'),))
        self.assert_answer(answer, True, bus.OK)
        self.assertEqual(answer.data, b'\x01\x02\x03')
        self.assert_answer(unsupported, False, bus.ERROR, 0x8000)
        self.assert_wire(bytes.fromhex('a501553007c6'), bytes.fromhex('a5000f00aa'))

    def test_echo_returns_the_round_trip_in_milliseconds(self):
        def timed():
            began = time.monotonic()
            answer = self.echo()
            return answer.success and (answer, (time.monotonic() - began) * 1e3)
        answer, took = again_if_stalled(timed)
        number = re.match(r'(\d+\.?\d*) ms$', answer.message)
        self.assertTrue(number, answer.message)
        self.assertTrue(0 < float(number.group(1)) < took, answer.message)

    def test_sync_has_its_exact_bytes_and_is_repeated_before_it_fails(self):
        def sends_it():
            settle(self.node, self.board)
            answer = self.sync()
            self.assertTrue(answer.message)
            return answer.success and bytes(self.board.wire) == SYNC_FRAME
        again_if_stalled(sends_it)

        def repeats_it():
            settle(self.node, self.board)
            self.board.rule = lambda request: b'' if request.cmd1 == bus.SYNC else None
            answer = self.sync()
            self.board.rule = lambda request: None
            self.assertFalse(answer.success)
            return answer.message.startswith('no reply') \
                and self.board.raws.count(SYNC_FRAME) >= 3
        again_if_stalled(repeats_it)


class Closed(unittest.TestCase):
    """A port that is absent: every service answers long before its timeout of 60 s."""

    def test_every_service_answers_not_sent_at_once(self):
        for name, service_class, arguments in (
                ('lift', Lift, (0, 1)), ('gimbal', Gimbal, (0, 1)),
                ('get_environment', GetEnvironment, ()),
                ('bus/request', BusRequest, (0x55, 0x30, b'')), ('bus/echo', Trigger, ()),
                ('bus/sync', Trigger, ())):
            answer = Waiter(service('/closed/' + name, service_class), *arguments).result()
            self.assertFalse(answer.success, name)
            self.assertIn('_absent is closed', answer.message)
            if service_class is not Trigger:
                self.assertEqual((answer.status, answer.error_code), (NOT_SENT, 0), name)


if __name__ == '__main__':
    rospy.init_node('bus_test')
    rostest.rosrun(PACKAGE, 'bus', '__main__')
