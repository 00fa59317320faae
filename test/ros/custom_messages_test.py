#!/usr/bin/python3
"""Custom messages and functions: every example of config/custom_messages.yaml and more, checked by
values on both sides of real ttys, and every mistake that only ROS can reveal."""
import math
import re
import struct
import unittest
from functools import partial, reduce

import pytest
import rospy
import rostest
from geometry_msgs.msg import Vector3
from nav_msgs.msg import Odometry
from roscpp.srv import GetLoggers
from sensor_msgs.msg import (CameraInfo, FluidPressure, JointState, MagneticField, Range)
from std_msgs.msg import (Bool, Float32, Int16MultiArray, String, UInt8MultiArray, UInt16,
                          UInt16MultiArray)
from std_srvs.srv import SetBool
from tf2_msgs.msg import TFMessage

from boards import (NOT_SENT, PACKAGE, BusBoard, CarBoard, SensorBoard, Topic, Waiter,
                    again_if_stalled, level_imu, plug, service, until, until_in_step)
from serial_communication.msg import SerialMsg
from serial_communication.framing import announcement, cobs
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.bus import wire as bus
from serial_communication.tools.watch.calls import Verdict, read_error, read_response
from serial_communication.framing.rows import RowError
from serial_communication.ros.parameters import NameTaken, check, resolved_names
from serial_communication.srv import Lift

OWN = '/' + PACKAGE + '/'
NO_REPLY = ('no reply within %g s: it is not known whether this was executed; '
            'check the robot before you repeat it')


class RecordingCar(CarBoard):
    """The model car, which also records the packets of unknown types."""

    @property
    def unknown(self):
        """The bytes of the packets whose types are not built in."""
        return [frame.raw for frame in self.bad]


class AnsweringBoard(BusBoard):
    """Answers custom functions from `answers`: an answer, a function that returns it, or None for
    no answer. It answers other requests as usual."""

    def __init__(self, path):
        self.answers = {}
        self.all = []
        super().__init__(path)

    def take(self, frame):
        self.all.append(frame)
        if frame.type == bus.FUNCTION and frame.number >= 0x30:
            answer = self.answers.get(frame.number, bus.Reply(bus.ERROR, b'\0\x80'))
            self.say(answer() if callable(answer) else answer)
        else:
            super().take(frame)


def setUpModule():
    """Start the boards, which all tests share, and record the log."""
    global CAR, SENSORS, BOARD
    line = rospy.get_param('~line')
    plug(line + '_bus', line + '_arduino', line + '_mcu')
    CAR = RecordingCar(line + '_arduino_board')
    SENSORS = SensorBoard(line + '_mcu_board')
    BOARD = AnsweringBoard(line + '_bus_board')
    until(lambda: CAR.connected and SENSORS.connected, 'the boards have their ports')
    CAR.say(level_imu())


def packet(type_, data=b''):
    """A packet on the wire, encoded by the definition of COBS."""
    return cobs.encode(bytes((type_,)) + data) + b'\0'


# Topic, ROS type, packet type, data, and the fields of the message.
VALUES = (
    *(('force', Float32, 32, struct.pack('<h', raw), {'data': value})
      for raw, value in ((12345, 123.45), (0, 0.0), (30000, 300.0))),
    # Nested fields, big-endian, and a value that is left out.
    ('magnetic_field', MagneticField, 33, b'\xff' + struct.pack('>3h', 1000, -32768, 32767),
     {'magnetic_field.x': 1.5e-4, 'magnetic_field.y': -4.9152e-3, 'magnetic_field.z': 4.91505e-3,
      'header.frame_id': 'robot/magnetometer'}),
    *(('line_sensors', UInt16MultiArray, 34, struct.pack(f'<{len(values)}H', *values),
       {'data': values}) for values in ((), (1,), (1, 2, 1023) * 20)),
    *(('bits', UInt8MultiArray, 201, data, {'data': data}) for data in (b'\1\0\xff', b'')),
    # Elements of an array, and an offset.
    ('joints', JointState, 35, struct.pack('<2H', 0, 4096),
     {'position': (-math.pi, math.pi), 'velocity': ()}),
    *(('firmware_version', String, 36, data, {'data': text}) for data, text in (
        (b'1.2', '1.2'), (b'1.2\0', '1.2'), (b'a\0b', 'a'), (b'', ''), ('°'.encode(), '°'),
        (b'\xff', '\ufffd'))),
    *(('bumper', Bool, 37, data, {'data': value})
      for data, value in ((b'\0', False), (b'\1', True), (b'\x80', True))),
    ('class', Bool, 207, b'\1', {'data': True}),       # a keyword of Python
    ('odd', CameraInfo, 200, struct.pack('>hxQ2sdH', -7, 2**40, b'ab', 5.5, 9),
     {'height': 114, 'P': (0.0,) * 3 + (2.0**40,) + (0.0,) * 8, 'distortion_model': 'ab',
      'roi.x_offset': 6, 'roi.do_rectify': True}),
)


def has(fields, message):
    """Whether the fields of a message have these values; numbers as float32 has them."""
    return all(reduce(getattr, path.split('.'), message) == pytest.approx(value, rel=1e-6)
               if isinstance(value, (float, tuple)) else
               reduce(getattr, path.split('.'), message) == value
               for path, value in fields.items())


class FromTheCar(unittest.TestCase):
    """Topics of the arduino link."""

    def first(self, name, message_class, type_, data, condition=lambda message: True):
        """Send a packet until its message is received, and return that."""
        topic = Topic(OWN + name, message_class)
        self.addCleanup(topic.close)
        return topic.first(condition, doing=lambda: CAR.write(packet(type_, data)),
                           what=f'has what {data.hex()} means')

    def test_values_of_every_kind_are_published(self):
        began = rospy.Time.now()
        for name, message_class, type_, data, fields in VALUES:
            message = self.first(name, message_class, type_, data, partial(has, fields))
            if message._has_header:
                self.assertGreaterEqual(message.header.stamp, began)

    def test_odometry_has_a_quaternion_covariances_and_both_frames(self):
        transforms = Topic('/tf', TFMessage)
        self.addCleanup(transforms.close)
        for x, y, yaw in (1500, -250, 1571), (1000, 0, -3142):      # twice, as it is reused
            data = struct.pack('<5h', x, y, yaw, 300, 40)
            message = self.first('odometry', Odometry, 211, data,
                                 lambda m, x=x: m.pose.pose.position.x == x / 1000)
            at, turn = message.pose.pose.position, message.pose.pose.orientation
            self.assertEqual((at.y, at.z), (y / 1000, 0))
            for value, right in zip((turn.x, turn.y, turn.z, turn.w), (
                    0, 0, math.sin(yaw / 2000), math.cos(yaw / 2000))):
                self.assertAlmostEqual(value, right, 12)
            self.assertEqual((message.twist.twist.linear.x, message.twist.twist.angular.z),
                             (0.3, 0.04))
            self.assertEqual({index: value for index, value in enumerate(message.pose.covariance)
                              if value}, {0: 0.25, 7: 0.5, 14: 1e6, 21: 1e6, 28: 1e6, 35: 0.75})
            self.assertEqual([i for i, value in enumerate(message.twist.covariance) if value], [35])
            self.assertEqual((message.header.frame_id, message.child_frame_id),
                             ('robot/odom', 'robot/base'))
            found = until(lambda x=x: [
                t for m in list(transforms.messages) for t in m.transforms
                if t.child_frame_id == 'robot/base' and t.transform.translation.x == x / 1000],
                'it is on /tf, too', doing=lambda data=data: CAR.write(packet(211, data)))[-1]
            self.assertEqual(found.header.frame_id, 'robot/odom')
            self.assertGreater(found.header.stamp, rospy.Time(0))
            self.assertAlmostEqual(found.transform.rotation.z, turn.z, 12)

    def test_texts_of_serial_msg_have_the_name_and_the_values(self):
        frames = Topic('/serial_msg', SerialMsg)
        self.addCleanup(frames.close)
        for type_, data, text in (
                (32, struct.pack('<h', 250), 'force data=2.5'),
                (34, b'\5\0\6\0', 'line_sensors data=[5 6]'),
                (36, b'v\x1b', "firmware_version data='v\ufffd'"), (37, b'\1', 'bumper data=true')):
            message = frames.first(lambda m, t=type_: m.type == t and not m.error,
                                   doing=lambda t=type_, d=data: CAR.write(packet(t, d)))
            self.assertEqual((message.text, message.link, bytes(message.data)),
                             (text, 'arduino', data))
            frames.forget()

    def test_a_message_without_a_value_is_left_out_where_the_field_cannot_be_nan(self):
        topic, frames = Topic(OWN + 'revolutions', UInt16), Topic('/serial_msg', SerialMsg)
        for each in topic, frames:
            self.addCleanup(each.close)
        frames.first(lambda m: (m.text, m.error) == ('revolutions data=none', ''),
                     doing=lambda: CAR.write(packet(210, b'\xff\xff')))
        topic.first(doing=lambda: CAR.write(packet(210, b'\5\0')))
        self.assertEqual(topic.messages[0].data, 5)


class ToTheCar(unittest.TestCase):
    """Custom commands."""

    def command(self, name, message_class):
        topic = rospy.Publisher(OWN + name, message_class, queue_size=10)
        self.addCleanup(topic.unregister)
        until(topic.get_num_connections, f'{name} is subscribed')
        return topic

    def sends(self, topic, message, expected):
        until(lambda: expected in CAR.unknown, f'{expected} on the wire', every=0.1,
              doing=lambda: topic.publish(message))

    def test_commands_have_their_exact_bytes(self):
        gripper = self.command('gripper', Vector3)
        for x, z, raw in ((12.5, 0.5, (125, 128)), (-100, 0, (-1000, 0)), (100, 1, (1000, 255))):
            self.sends(gripper, Vector3(x, 7.0, z), packet(48, struct.pack('<hB', *raw)))
        self.sends(self.command('say', String), String('hé'), packet(202, 'hé'.encode()))
        message = Int16MultiArray(data=[1, -2, 3])
        message.layout.data_offset = 9
        self.sends(self.command('several', Int16MultiArray), message,
                   packet(203, struct.pack('>B3h', 9, 1, -2, 3)))
        self.sends(self.command('third', JointState), JointState(position=[7, 8, 9]),
                   packet(204, struct.pack('<h', 9)))


class FromTheSensors(unittest.TestCase):
    """Topics of the mcu link."""

    def test_a_custom_frame_is_published(self):
        topic = Topic('/mcu/cliff', Range)
        self.addCleanup(topic.close)
        seqs = iter(range(1 << 30))
        message = topic.first(doing=lambda: SENSORS.write(mcu.encode_raw(
            0x20, next(seqs) % 256, struct.pack('<H', 1500))))
        self.assertAlmostEqual(message.range, 1.5, 6)
        self.assertEqual((message.header.frame_id, message.radiation_type),
                         ('robot/cliff', Range.INFRARED))
        self.assertAlmostEqual(message.field_of_view, 0.44, 6)
        topic.first(lambda m: math.isnan(m.range), what='no value', doing=lambda: SENSORS.write(
            mcu.encode_raw(0x20, next(seqs) % 256, b'\xff\xff')))
        frames = Topic('/serial_msg', SerialMsg)
        self.addCleanup(frames.close)
        for data, error in ((b'\1\0\0', 'length: cliff with 3 bytes of data where 2 is'),
                            (struct.pack('<H', 2001), 'implausible: cliff: range is 2.001, out'),
                            (struct.pack('<H', 2000), '')):
            frames.first(lambda m, e=error: m.type == 0x20 and m.error.startswith(e),
                         doing=lambda d=data: SENSORS.write(mcu.encode_raw(
                             0x20, next(seqs) % 256, d)))


class Functions(unittest.TestCase):
    """Custom functions of the bus: services and polled topics."""

    def setUp(self):
        until(lambda: BOARD.connected and bus.SYNC_REQUEST in [f.message for f in BOARD.all],
              'the bus is synchronised')
        BOARD.answers.clear()

    def once(self, name, service_class, *arguments):
        """The answer to a call, or the text of its error."""
        try:
            return Waiter(service(OWN + name, service_class), *arguments).result()
        except rospy.ServiceException as error:
            return str(error)

    def call(self, name, service_class, *arguments):
        """The answer to a call, which is made again if a stall of this machine kept it back, or
        dropped the reply."""
        def answered():
            until_in_step(PACKAGE)
            answer = self.once(name, service_class, *arguments)
            words = getattr(answer, 'message', str(answer))
            return None if re.search('nothing was sent|not known whether', words) else answer
        return again_if_stalled(answered)

    def asked(self, cmd2):
        return [frame.raw for frame in BOARD.all
                if frame.type == bus.FUNCTION and frame.number == cmd2]

    def test_a_call_sends_its_request_and_returns_the_reply(self):
        BOARD.answers[0x30] = bus.Reply(bus.OK)
        answer = self.call('pump', SetBool, True)
        self.assertEqual((answer.success, answer.message), (True, 'done: pump data=true'))
        self.assertEqual(self.asked(0x30)[-1], bytes.fromhex('a501553001c0'))
        BOARD.answers[0x30] = bus.Reply(bus.ERROR, b'\2\x80')
        answer = self.call('pump', SetBool, False)
        self.assertFalse(answer.success)
        self.assertIn('the operation failed', answer.message)
        BOARD.answers[0x30] = bus.Reply(bus.OK, b'\1')
        answer = self.call('pump', SetBool, False)
        self.assertTrue(answer.success, 'a board may send data where none is expected')

    def test_a_response_has_the_outcome_and_the_values(self):
        BOARD.answers[0x35] = bus.Reply(bus.OK, b'\0')
        answer = self.call('gentle', Lift, 1, 9)
        self.assertEqual((answer.success, answer.status, answer.error_code), (True, bus.OK, 0))
        self.assertEqual(self.asked(0x35)[-1][4:6], b'\x09\1')
        before = len(self.asked(0x35))
        answer = self.once('gentle', Lift, 1, 10)
        self.assertEqual((answer.success, answer.status), (False, NOT_SENT))
        self.assertIn('distance is 10, out of range (-inf … 9', answer.message)
        self.assertEqual(len(self.asked(0x35)), before)

    def test_without_success_a_failure_is_a_service_error(self):
        BOARD.answers[0x34] = bus.Reply(bus.OK, b'full')
        answer = self.call('level', GetLoggers)
        self.assertEqual([logger.name for logger in answer.loggers], ['full'])
        self.assertEqual(read_response(answer), (Verdict.DONE, 'done'))
        BOARD.answers[0x34] = bus.Reply(bus.ERROR, b'\0\x80')
        self.assert_error('the board refused: 0x8000: the board does not support this command')
        BOARD.answers[0x34] = None
        self.assert_error(NO_REPLY % 0.3)

    def assert_error(self, message):
        """A service whose type has no outcome fields raises this."""
        def raised():       # with other words if this machine stalls
            until_in_step(PACKAGE)
            with self.assertRaises(rospy.ServiceException) as caught:
                Waiter(service(OWN + 'level', GetLoggers)).result()
            verdict, text = read_error(caught.exception)
            self.assertIs(verdict, Verdict.FAILED)
            return message in text
        again_if_stalled(raised)

    def test_replies_of_polled_functions_are_published(self):
        BOARD.answers[0x32] = bus.Reply(bus.OK, struct.pack('<H', 10132))
        topic = Topic(OWN + 'tank', FluidPressure)
        frames = Topic('/serial_msg', SerialMsg)
        self.addCleanup(topic.close)
        self.addCleanup(frames.close)
        message = topic.next(lambda m: m.fluid_pressure == 101320)
        self.assertEqual((message.header.frame_id, message.variance), ('robot/tank', 10000))
        frames.first(lambda m: m.text == 'tank' and m.direction == SerialMsg.TX)
        frames.first(lambda m: m.text == 'tank OK fluid_pressure=101320')
        self.assertGreater(len(self.asked(0x32)), 0)
        self.assertEqual(self.asked(announcement.TYPE), [], 'bus/announcements is false')


FORCE = {'type': 32, 'ros_type': 'std_msgs/Float32', 'layout': '<h', 'fields': ['data']}
PUMP = {'cmd2': 0x30, 'srv_type': 'std_srvs/SetBool'}


class Mistakes(unittest.TestCase):
    """Mistakes in rows that only ROS can reveal."""

    def assert_mistake(self, group, name, row, key):
        section, rows = group.split('/')
        with self.subTest(row), self.assertRaises(RowError) as mistake:
            check({section: {rows: {name: row}}})
        text = str(mistake.exception)
        self.assertTrue(text.startswith(f'{group}/{name}{key} is '), text)
        self.assertNotIn('\n', text)

    def test_wrong_types_fields_and_names_are_refused(self):
        covariance = {'ros_type': 'sensor_msgs/Imu', 'fields': ['orientation_covariance']}
        for changes, key in (
                ({'ros_type': 'std_msgs/Flot32'}, '/ros_type'),
                ({'ros_type': 'std_msg/Float32'}, '/ros_type'),
                # Modules and classes that are not messages.
                ({'ros_type': 'rospy/struct'}, '/ros_type'),
                ({'ros_type': 'rospy/AnyMsg'}, '/ros_type'), ({'ros_type': 'os/path'}, '/ros_type'),
                ({'fields': ['dta']}, '/fields'), ({'fields': ['data.x']}, '/fields'),
                ({'fields': ['data[0]']}, '/fields'), ({'layout': '<s'}, '/fields'),
                ({'layout': '<h*'}, '/fields'), ({'frame_id': 'x'}, '/frame_id'),
                ({'layout': '<I', 'fields': ['@time']}, '/fields'),
                ({'ros_type': 'std_msgs/String'}, '/fields'),
                ({'ros_type': 'std_msgs/Header', 'fields': ['stamp']}, '/fields'),
                (covariance, '/fields'), (dict(covariance, layout='<h*'), '/fields'),
                (dict(covariance, fields=['orientation_covariance[9]']), '/fields'),
                (dict(covariance, fields=['orientation.q']), '/fields'),
                ({'scale': 0}, '/scale')):
            self.assert_mistake('arduino/messages', 'force', dict(FORCE, **changes), key)
        for changes, key in (
                ({'srv_type': 'std_srvs/SetBoolRequest'}, '/srv_type'),
                ({'srv_type': 'std_srv/SetBool'}, '/srv_type'),
                ({'srv_type': 'std_srvs/SetBol'}, '/srv_type'),
                ({'request': {'layout': '<?', 'fields': ['dat']}}, '/request/fields'),
                ({'reply': {'layout': '<?', 'fields': ['success'], 'invalid': 1}},
                 '/reply/invalid'),
                ({'reply': {'layout': '<?', 'fields': ['data']}}, '/reply/fields')):
            self.assert_mistake('bus/functions', 'pump', dict(PUMP, **changes), key)

    def test_constants_that_the_type_cannot_hold_are_refused(self):
        battery = dict(FORCE, ros_type='sensor_msgs/BatteryState', fields=['voltage'])
        for constants, key in (
                ({'presnt': True}, ''), ({'charge': 'full'}, '/charge'),
                ({'charge': 1e39}, '/charge'),
                ({'power_supply_status': 256}, '/power_supply_status'),
                ({'power_supply_status': 0.5}, '/power_supply_status'),
                ({'location': 5}, '/location'),
                ({'cell_voltage': 3.7}, '/cell_voltage'), ({'header.stamp': 0}, '/header.stamp'),
                ({'orientation.yaw': 1.0}, '')):
            self.assert_mistake('arduino/messages', 'pack', dict(battery, constants=constants),
                                '/constants' + key)
        check({'arduino': {'messages': {'pack': dict(battery, constants={
            'charge': float('nan'), 'cell_voltage[1]': 4, 'power_supply_status': 255})}}})

    def test_reserved_and_repeated_names_are_refused(self):
        for group, name, row in (
                ('arduino/messages', 'voltage', FORCE), ('arduino/messages', 'lift', FORCE),
                ('mcu/messages', 'range_1', FORCE), ('bus/functions', 'gimbal', PUMP)):
            section, rows = group.split('/')
            given = {board: {'port': '/dev/' + board} for board in ('bus', 'arduino', 'mcu')}
            given[section][rows] = {name: row}
            with self.assertRaisesRegex(NameTaken, f'/{name} is the name of .* and of '):
                resolved_names(check(given)[1])
        given = {'arduino': {'port': '/dev/a', 'messages': {'both': FORCE}},
                 'bus': {'port': '/dev/b', 'functions': {'both': PUMP}}}
        with self.assertRaisesRegex(NameTaken, '/both is the name of .* and of '):
            resolved_names(check(given)[1])
        # These names differ: mcu/imu is not ~imu, and a topic may have the name of a parameter.
        check({'arduino': {'messages': {'status': FORCE, 'port': dict(FORCE, type=33)}},
               'mcu': {'messages': {'voltage': FORCE}}})


if __name__ == '__main__':
    rospy.init_node('custom_messages_test')
    rostest.rosrun(PACKAGE, 'custom_messages', '__main__')
