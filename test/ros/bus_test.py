#!/usr/bin/python3
"""The bus link: every service, the exact bytes, and what the caller is told."""
import re
import time
import unittest

import rospy
import rostest
from sensor_msgs.msg import RelativeHumidity, Temperature
from std_srvs.srv import Trigger

from boards import (AIR, AIR_DATA, NOT_SENT, PACKAGE, SYNC_FRAME, TIMEOUT, BusBoard, Topic,
                    Waiter, service, settle, until, values_of)
from serial_communication.msg import Environment
from serial_communication.boards.bus import wire as bus
from serial_communication.srv import (BusRequest, GetEnvironment, Gimbal,
                                      GimbalRequest, Lift, LiftRequest)

LIFT_UP_100 = bytes.fromhex('a50255200064b6')
GIMBAL_LEFT_30 = bytes.fromhex('a5025521001ecd')
ENVIRONMENT = bytes.fromhex('a5025522d0')
DONE = bus.Reply(bus.OK)
FAILED = bus.Reply(bus.ERROR, bytes.fromhex('0280'))


def setUpModule():
    """The boards, and what the first one has read before any test."""
    global BOARDS, BEGAN_WITH
    line = rospy.get_param('~line')
    BOARDS = {PACKAGE: BusBoard(line + '_board'),
              'strict': BusBoard(line + '_strict_board', has_cmd2=True, polled=True)}
    until(lambda: BOARDS[PACKAGE].frames, 'a first request')
    BEGAN_WITH = bytes(BOARDS[PACKAGE].wire)


def invalid(code):
    """An INVALID reply."""
    return bus.Reply(bus.INVALID, bytes((code,)))


class BusTest(unittest.TestCase):
    """One board at the end of one line."""

    node = PACKAGE

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

    def assert_answer(self, answer, success, status, error_code=0):
        self.assertEqual((answer.success, answer.status, answer.error_code),
                         (success, status, error_code), answer.message)
        self.assertTrue(answer.message.strip())
        self.assertNotIn('\n', answer.message)

    def assert_wire(self, *expected):
        """These are the exact bytes on the wire, but for the ECHOs that stand as fences."""
        self.assertEqual([frame.raw for frame in self.board.frames if frame.type != bus.ECHO],
                         list(expected))
        self.assertEqual(bytes(self.board.wire), b''.join(self.board.raws))

    def assert_nothing_was_sent(self):
        """Nothing stands on the wire before this very ECHO."""
        self.assertTrue(self.echo().success)
        self.assertEqual([frame.type for frame in self.board.frames], [bus.ECHO])
        self.assertEqual(bytes(self.board.wire), self.board.raws[0])


class Moves(BusTest):
    """Lift and gimbal."""

    def test_sync_is_the_first_on_the_wire(self):
        self.assertEqual(BEGAN_WITH[:5], SYNC_FRAME)

    def test_lift_has_its_exact_bytes(self):
        self.assert_answer(self.lift(LiftRequest.UP, 100), True, bus.OK)
        self.assert_answer(self.lift(LiftRequest.DOWN, 255), True, bus.OK)
        self.assert_wire(LIFT_UP_100, bytes.fromhex('a502552001ff2c'))

    def test_gimbal_has_its_exact_bytes(self):
        for direction in (GimbalRequest.LEFT, GimbalRequest.RIGHT, GimbalRequest.UP,
                          GimbalRequest.DOWN):
            self.assert_answer(self.gimbal(direction, 90), True, bus.OK)
        self.assert_answer(self.gimbal(GimbalRequest.LEFT, 30), True, bus.OK)
        self.assert_wire(*[bytes.fromhex(frame) for frame in (
            'a5025521005a89', 'a5025521015a88', 'a5025521025a8b', 'a5025521035a8a',
            'a5025521001ecd')])

    def test_a_lift_direction_out_of_range_is_not_sent(self):
        answer = self.lift(2, 10)
        self.assert_answer(answer, False, NOT_SENT)
        self.assertIn('direction is 2', answer.message)
        self.assert_nothing_was_sent()

    def test_a_gimbal_direction_out_of_range_is_not_sent(self):
        for direction in (4, 255):
            answer = self.gimbal(direction, 10)
            self.assert_answer(answer, False, NOT_SENT)
            self.assertIn('direction is %d' % direction, answer.message)
        self.assert_nothing_was_sent()

    def test_an_error_of_the_board_is_told(self):
        self.board.script += [FAILED]
        self.assert_answer(self.lift(0, 100), False, bus.ERROR, 0x8002)
        self.assert_wire(LIFT_UP_100)

    def test_a_frame_damaged_on_the_way_is_sent_again_as_it_was(self):
        self.board.script += [invalid(0x40), DONE]
        self.assert_answer(self.lift(0, 100), True, bus.OK)
        self.assertEqual(self.board.others, [LIFT_UP_100, LIFT_UP_100])

    def test_a_frame_damaged_every_time_is_given_up(self):
        self.board.script += [invalid(0x40)] * 3
        self.assert_answer(self.lift(0, 100), False, bus.INVALID, 0x40)
        self.assertEqual(self.board.others, [LIFT_UP_100] * 3)

    def test_an_invalid_that_was_for_noise_does_not_double_the_move(self):
        self.board.script += [lambda request: bus.encode_reply(invalid(0x40))
                              + bus.encode_reply(DONE)]
        # An OK of another request would look the same: it is told as not known.
        self.assert_answer(self.lift(0, 100), False, TIMEOUT, 0x40)
        self.assertTrue(self.echo().success)
        self.assertEqual(self.board.others, [LIFT_UP_100])

    def test_an_unsynchronised_board_gets_sync_and_then_the_request_again(self):
        self.board.script += [invalid(0x10), DONE]
        self.assert_answer(self.lift(0, 100), True, bus.OK)
        self.assert_wire(LIFT_UP_100, SYNC_FRAME, LIFT_UP_100)

    def test_a_frame_too_long_for_the_board_is_refused(self):
        self.board.script += [invalid(0x20)]
        self.assert_answer(self.lift(0, 100), False, bus.INVALID, 0x20)
        self.assertTrue(self.echo().success)
        self.assertEqual(self.board.others, [LIFT_UP_100])


class NoReply(BusTest):
    """What follows a reply that does not come."""

    def test_a_move_times_out_after_motion_timeout_and_is_not_sent_again(self):
        for call, frame in ((self.lift, LIFT_UP_100), (self.gimbal, GIMBAL_LEFT_30)):
            self.board.forget()
            self.board.script += [b'']
            waiter = Waiter(call, 0, frame[5])
            self.assert_answer(waiter.result(), False, TIMEOUT)
            self.assertGreaterEqual(waiter.took, 0.8)
            self.assertLess(waiter.took, 0.8 + 1.0)
            self.assertTrue(self.echo().success)
            self.assertEqual(self.board.others, [frame])

    def test_a_raw_request_times_out_after_reply_timeout_and_is_not_sent_again(self):
        self.board.script += [b'']
        waiter = Waiter(self.request, 0x55, 0x30, b'')
        self.assert_answer(waiter.result(), False, TIMEOUT)
        self.assertGreaterEqual(waiter.took, 0.4)
        self.assertLess(waiter.took, 0.4 + 1.0)
        self.assertTrue(self.echo().success)
        self.assertEqual(self.board.others, [bytes.fromhex('a5005530c0')])

    def test_the_next_request_waits_for_the_nonce_of_a_fresh_echo(self):
        nonces = []

        def answer_the_second_echo(request):
            nonces.append(request.data)
            if len(nonces) == 2:
                self.board.say(bus.Reply(bus.ECHO, nonces[0]))
                self.board.say(bus.Reply(bus.OK))
            return None if len(nonces) > 1 else b''

        def say_nothing_from_here(_request):
            self.board.rule = lambda request: (
                answer_the_second_echo(request) if request.cmd1 == bus.ECHO else None)
            return b''

        self.board.script += [say_nothing_from_here]
        self.assert_answer(self.lift(0, 100), False, TIMEOUT)
        self.assert_answer(self.gimbal(0, 30), True, bus.OK)
        self.assertEqual([frame.type for frame in self.board.frames][-4:],
                         [bus.FUNCTION, bus.ECHO, bus.ECHO, bus.FUNCTION])
        self.assertEqual(self.board.others, [LIFT_UP_100, GIMBAL_LEFT_30])
        self.assertEqual([len(nonce) for nonce in nonces], [4, 4])
        self.assertNotEqual(*nonces)

    def test_a_late_reply_is_not_taken_for_the_next_ones(self):
        late = [DONE]

        def late_reply_first(request):
            if late:
                self.board.say(late.pop())
            return FAILED if request.cmd1 == bus.FUNCTION else None

        def say_nothing_from_here(_request):
            self.board.rule = late_reply_first
            return b''

        self.board.script += [say_nothing_from_here]
        self.assert_answer(self.lift(0, 100), False, TIMEOUT)
        self.assert_answer(self.gimbal(0, 30), False, bus.ERROR, 0x8002)
        self.assertEqual(self.board.others, [LIFT_UP_100, GIMBAL_LEFT_30])

    def test_a_doubled_reply_is_followed_by_an_echo(self):
        self.board.script += [lambda request: bus.encode_reply(DONE) * 2, FAILED]
        self.assert_answer(self.lift(0, 100), True, bus.OK)
        until(lambda: self.board.frames[-1].type == bus.ECHO, 'an ECHO follows the doubled reply')
        self.assert_answer(self.gimbal(0, 30), False, bus.ERROR, 0x8002)
        self.assertEqual([frame.type for frame in self.board.frames][-3:],
                         [bus.FUNCTION, bus.ECHO, bus.FUNCTION])

    def test_a_reply_that_comes_twice_does_not_hide_a_refusal(self):
        """Its copy is on the way for 5 ms: the next lift is asked before it is there."""
        def done_twice(_request):
            self.board.say(DONE)
            time.sleep(0.005)
            return DONE

        for _ in range(20):
            self.board.script += [done_twice, FAILED]
            self.assert_answer(self.lift(0, 10), True, bus.OK)
            self.assert_answer(self.lift(0, 200), False, bus.ERROR, 0x8002)

    def test_a_damaged_reply_leaves_the_outcome_unknown(self):
        self.board.script += [bytes.fromhex('a50002a6')]
        self.assert_answer(self.lift(0, 100), False, TIMEOUT)
        self.assertTrue(self.echo().success)
        self.assertEqual(self.board.others, [LIFT_UP_100])

    def test_a_board_that_answers_sync_but_never_echo_is_served(self):
        def never_echo_from_here(_request):
            self.board.rule = lambda request: b'' if request.cmd1 == bus.ECHO else None
            return b''

        self.board.script += [never_echo_from_here]
        self.assert_answer(self.request(0x55, 0x30, b''), False, TIMEOUT)
        until(lambda: self.board.raws[-1] == SYNC_FRAME, 'a SYNC takes the place of ECHO')
        self.assertEqual([frame.type for frame in self.board.frames][-5:],
                         [bus.FUNCTION] + [bus.ECHO] * 3 + [bus.SYNC])
        answered = until(lambda: self.lift(0, 100).success, 'calls are served again')
        self.assertTrue(answered)

    def test_echo_and_sync_are_repeated_and_then_told(self):
        self.board.rule = lambda request: b'' if request.cmd1 == bus.SYNC else None
        answer = self.sync()
        self.assertFalse(answer.success)
        self.assertTrue(answer.message.startswith('status 254 (not known): no reply'))
        self.board.rule = lambda request: None
        self.assertGreaterEqual(self.board.raws.count(SYNC_FRAME), 2)


class Air(BusTest):
    """Environment readings."""

    def setUp(self):
        super().setUp()
        self.board.air = AIR

    def test_a_fresh_reading_has_its_values_and_exact_bytes(self):
        began = rospy.Time.now()
        answer = self.get_environment()
        self.assert_answer(answer, True, bus.OK)
        self.assert_wire(ENVIRONMENT)
        reading = answer.environment
        self.assertEqual(reading.smoke, 350)
        self.assertAlmostEqual(reading.temperature, 25.63, 5)
        self.assertAlmostEqual(reading.humidity, 48.12, 5)
        self.assertLess(abs((reading.header.stamp - began).to_sec()), 5.0)

    def test_a_reading_is_published_in_the_units_of_each_topic(self):
        raw = Topic('/serial_communication/environment', Environment)
        temperature = Topic('/serial_communication/environment/temperature', Temperature)
        humidity = Topic('/serial_communication/environment/humidity', RelativeHumidity)
        self.board.air = bus.Environment(65535, -12.5, 48.12)
        message = raw.first(doing=self.get_environment)
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

    def test_a_reading_is_asked_for_again_when_no_reply_comes(self):
        self.board.script += [b'']
        self.assert_answer(self.get_environment(), True, bus.OK)
        self.assertEqual(self.board.others, [ENVIRONMENT] * 2)

    def test_an_error_of_the_board_is_told(self):
        self.board.script += [bus.Reply(bus.ERROR, bytes.fromhex('0080'))]
        answer = self.get_environment()
        self.assert_answer(answer, False, bus.ERROR, 0x8000)
        self.assertEqual(answer.environment.smoke, 0)

    def test_a_period_of_zero_never_polls(self):
        other = Topic('/strict/environment', Environment)
        until(lambda: len(other.messages) >= 10, 'ten polls of the other board')
        self.assertEqual(self.board.others, [])

    def test_an_ok_with_data_is_the_moves_behind_a_fence(self):
        self.board.script += [bus.Reply(bus.OK, AIR_DATA)] * 2
        self.assert_answer(self.lift(0, 100), True, bus.OK)
        self.assert_answer(self.gimbal(0, 30), True, bus.OK)

    def test_a_reading_of_a_wrong_length_is_told_as_that(self):
        self.board.script += [bus.Reply(bus.OK, bytes(4))]
        answer = self.get_environment()
        self.assert_answer(answer, False, bus.OK)
        self.assertIn('4 bytes', answer.message)
        self.assertIn('6 were expected', answer.message)
        self.assert_answer(self.lift(0, 100), True, bus.OK)


class Raw(BusTest):
    """bus/request, bus/echo, bus/sync."""

    def test_a_raw_request_carries_data_both_ways(self):
        self.board.script += [bus.Reply(bus.OK, b'\x01\x02\x03')]
        answer = self.request(0x55, 0x30, b'\x07')
        self.assert_answer(answer, True, bus.OK)
        self.assertEqual(answer.data, b'\x01\x02\x03')
        self.assert_wire(bytes.fromhex('a501553007c6'))

    def test_long_frames_carry_300_bytes_both_ways(self):
        data = bytes(range(256)) + bytes(range(44))
        self.board.script += [bus.Reply(bus.OK, data[::-1])]
        answer = self.request(0x55, 0x30, data)
        self.assert_answer(answer, True, bus.OK)
        self.assertEqual(answer.data, data[::-1])
        wire, = self.board.others
        self.assertEqual(wire[:-1], bytes.fromhex('5a2c015530') + data)
        checksum = 0
        for byte in wire:
            checksum ^= byte
        self.assertEqual(checksum, 0)

    def test_1024_bytes_are_sent_and_1025_are_not(self):
        self.board.script += [bus.Reply(bus.OK, bytes(1024))]
        answer = self.request(0x55, 0x30, bytes(1024))
        self.assert_answer(answer, True, bus.OK)
        self.assertEqual(answer.data, bytes(1024))
        self.board.forget()
        answer = self.request(0x55, 0x30, bytes(1025))
        self.assert_answer(answer, False, NOT_SENT)
        self.assertIn('1025', answer.message)
        self.assertIn('1024', answer.message)
        self.assert_nothing_was_sent()

    def test_a_cmd1_that_the_board_refuses_is_told(self):
        answer = self.request(0x0F, 0x00, b'')
        self.assert_answer(answer, False, bus.ERROR, 0x8000)
        self.assert_wire(bytes.fromhex('a5000f00aa'))

    def test_echo_tells_the_round_trip_in_milliseconds(self):
        began = time.monotonic()
        answer = self.echo()
        took = (time.monotonic() - began) * 1e3
        self.assertTrue(answer.success)
        number = re.match(r'(\d+\.?\d*) ms$', answer.message)
        self.assertTrue(number, answer.message)
        self.assertTrue(0 < float(number.group(1)) < took, answer.message)

    def test_sync_has_its_exact_bytes(self):
        answer = self.sync()
        self.assertTrue(answer.success)
        self.assertTrue(answer.message)
        self.assertEqual(bytes(self.board.wire), SYNC_FRAME)

    def test_of_many_callers_one_request_is_outstanding_and_each_gets_its_own_reply(self):
        overlaps = []

        def slowly(request):
            received = len(self.board.wire)
            time.sleep(0.02)       # for a second request to come, were it sent
            if self.board.unread() or len(self.board.wire) != received:
                overlaps.append(request)
            return bus.Reply(bus.OK, request.data)

        self.board.script += [slowly] * 12
        waiters = [Waiter(self.request, 0x55, 0x30, bytes((number,))) for number in range(12)]
        answers = [waiter.result() for waiter in waiters]
        self.assertEqual([answer.data for answer in answers],
                         [bytes((number,)) for number in range(12)])
        self.assertEqual(overlaps, [])
        self.assertEqual(len(self.board.others), 12)


class Strict(BusTest):
    """The board that counts Datelen strictly and whose replies carry CMD2; it is polled."""

    node = 'strict'

    def test_replies_with_cmd2_are_understood(self):
        self.assert_answer(self.lift(0, 100), True, bus.OK)
        self.board.script += [lambda request: bus.Reply(bus.OK, b'\x05', request.cmd2)]
        answer = self.request(0x55, 0x30, b'\x07')
        self.assert_answer(answer, True, bus.OK)
        self.assertEqual(answer.data, b'\x05')

    def test_polls_come_once_a_period_with_datelen_0_and_are_published(self):
        topic = Topic('/strict/environment', Environment)
        temperature = Topic('/strict/environment/temperature', Temperature)
        humidity = Topic('/strict/environment/humidity', RelativeHumidity)
        message = topic.first(lambda m: topic.messages.index(m) >= 9)
        self.assertEqual(set(self.board.others), {bytes.fromhex('a5005522d2')})
        self.assertEqual(message.header.frame_id, 'trunk')
        self.assertEqual(message.smoke, 350)
        self.assertAlmostEqual(message.temperature, 25.63, 5)
        self.assertAlmostEqual(message.humidity, 48.12, 5)
        self.assertAlmostEqual(temperature.first().temperature, 25.63)
        self.assertAlmostEqual(humidity.first().relative_humidity, 0.4812)
        stamps = [frame.stamp for frame in self.board.frames if frame.command == bus.ENVIRONMENT]
        self.assertGreater((stamps[-1] - stamps[0]) / (len(stamps) - 1), 0.09)

    def test_a_service_call_still_goes_through_beside_the_polls(self):
        answer = self.get_environment()
        self.assert_answer(answer, True, bus.OK)
        self.assertEqual(answer.environment.header.frame_id, 'trunk')


class Closed(unittest.TestCase):
    """A port that is not there: every service answers, at once and truthfully."""

    def test_every_service_answers_not_sent_at_once(self):
        calls = (('lift', Lift, (0, 1)), ('gimbal', Gimbal, (0, 1)),
                 ('get_environment', GetEnvironment, ()),
                 ('bus/request', BusRequest, (0x55, 0x30, b'')))
        for name, service_class, arguments in calls:
            call = service('/closed/' + name, service_class)
            answer = self.at_once(call, *arguments)
            self.assertEqual(values_of(answer, 'success', 'status', 'error_code'),
                             (False, NOT_SENT, 0), name)
            self.assertIn('_absent is closed', answer.message)

    def test_echo_and_sync_fail_at_once(self):
        for name in ('bus/echo', 'bus/sync'):
            answer = self.at_once(service('/closed/' + name, Trigger))
            self.assertFalse(answer.success, name)
            self.assertRegex(answer.message, r'^status 253 \(not sent\): .*_absent is closed')

    def at_once(self, call, *arguments):
        waiter = Waiter(call, *arguments)
        answer = waiter.result()
        self.assertLess(waiter.took, 0.4)    # less than reply_timeout
        return answer


if __name__ == '__main__':
    rospy.init_node('bus_test')
    rostest.rosrun(PACKAGE, 'bus', '__main__')
