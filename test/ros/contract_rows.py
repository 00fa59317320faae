"""Own messages and functions by parameters, announced ones, and settings."""
import math
from functools import reduce

import dynamic_reconfigure.client
import rosgraph
import rospy
from geometry_msgs.msg import Vector3
from nav_msgs.msg import Odometry
from roscpp.srv import GetLoggers
from sensor_msgs.msg import (BatteryState, CameraInfo, FluidPressure, JointState, MagneticField,
                             Range)
from std_msgs.msg import Bool, Float32, Int16MultiArray, String, UInt16, UInt16MultiArray
from std_srvs.srv import SetBool, Trigger
from tf2_msgs.msg import TFMessage

from boards import NODE, NOT_SENT, PACKAGE, names_of, service, settle, until
from by_definition import announcement, arduino_packet
from contract_robot import FIRMWARE, Contract, pack, resolved
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.mcu import wire as mcu
from serial_communication.msg import SerialMsg, Ticks
from serial_communication.srv import Lift

# Topic, ROS type, packet type, data, and the fields of the message.
VALUES = (
    ('force', Float32, 32, pack('h', 12345), {'data': 123.45}),
    *(('limited', Float32, 212, pack('h', raw), {'data': raw / 10}) for raw in (3, -3)),
    # Nested fields, big-endian, and a value that is left out.
    ('magnetic_field', MagneticField, 33, b'\xff\x03\xe8\x80\x00\x7f\xff',
     {'magnetic_field.x': 1.5e-4, 'magnetic_field.y': -4.9152e-3, 'magnetic_field.z': 4.91505e-3,
      'header.frame_id': 'robot/magnetometer'}),
    ('line_sensors', UInt16MultiArray, 34, pack('3H', 1, 2, 1023), {'data': (1, 2, 1023)}),
    # Elements of an array, and an offset.
    ('joints', JointState, 35, pack('2H', 0, 4096),
     {'position': (-math.pi, math.pi), 'velocity': ()}),
    *(('firmware_version', String, 36, data, {'data': text}) for data, text in (
        (b'a\0b', 'a'), ('°'.encode(), '°'))),
    ('bumper', Bool, 37, b'\x80', {'data': True}),
    ('battery', BatteryState, 38, pack('H', 7400),
     {'voltage': 7.4, 'present': True, 'location': 'front'}),
    ('odd', CameraInfo, 200, b'\xff\xf9\0' + (2**40).to_bytes(8, 'big') + b'ab'
     + bytes.fromhex('4016000000000000') + b'\0\x09',
     {'height': 114, 'P': (0.0,) * 3 + (2.0**40,) + (0.0,) * 8, 'distortion_model': 'ab',
      'roi.x_offset': 6, 'roi.do_rectify': True}),
)
FORCE = ('torque: {type: 50, ros_type: std_msgs/Float32, layout: "<h", fields: [data], '
         'scale: 0.01}\n')
LEVEL = 'depth: {type: 51, ros_type: std_msgs/UInt16, layout: "<H", fields: [data]}\n'
HORN = ('horn: {type: 52, direction: to_board, ros_type: std_msgs/UInt16, layout: "<H", '
        'fields: [data]}\n')
GAIN = 'gain: {setting: 7, layout: "<B", minimum: 1, maximum: 9}\n'


def has(fields, message):
    """Whether the fields of a message have these values; numbers as float32 has them."""
    def same(found, value):
        if isinstance(value, tuple):
            return len(found) == len(value) and all(map(same, found, value))
        return math.isclose(found, value, rel_tol=1e-6) if isinstance(value, float) \
            else found == value
    return all(same(reduce(getattr, path.split('.'), message), value)
               for path, value in fields.items())


class OwnMessages(Contract):
    """Rows of the parameters, from and to a board."""

    def test_values_of_every_kind_are_published(self):
        for name, kind, type_, data, fields in VALUES:
            self.topic(f'~{name}', kind).first(
                lambda m, f=fields: has(f, m), what=f'has what {data.hex()} means',
                doing=lambda t=type_, d=data: self.car.write(arduino_packet(t, d)))

    def test_odometry_has_a_quaternion_covariances_both_frames_and_a_pose_on_tf(self):
        odometry, transforms = self.topic('~odometry', Odometry), self.topic('tf', TFMessage)
        for x, y, yaw in (1500, -250, 1571), (1000, 0, -3142):      # twice, as it is reused
            packet = arduino_packet(211, pack('5h', x, y, yaw, 300, 40))
            message = odometry.first(lambda m, x=x: m.pose.pose.position.x == x / 1000,
                                     doing=lambda p=packet: self.car.write(p))
            at, turn = message.pose.pose.position, message.pose.pose.orientation
            self.assertEqual((at.y, at.z), (y / 1000, 0))
            self.assert_values((turn.x, turn.y, turn.z, turn.w),
                               (0, 0, math.sin(yaw / 2000), math.cos(yaw / 2000)), 12)
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
                'it is on /tf, too', doing=lambda p=packet: self.car.write(p))[-1]
            self.assertEqual(found.header.frame_id, 'robot/odom')
            self.assertAlmostEqual(found.transform.rotation.z, turn.z, 12)

    def test_no_value_is_nan_or_leaves_the_message_out_and_what_may_not_be_is_an_error(self):
        revolutions = self.topic('~revolutions', UInt16)
        frames = self.topic('serial_msg', SerialMsg)
        frames.first(lambda m: (m.text, m.error) == ('revolutions data=none', ''),
                     doing=lambda: self.car.write(arduino_packet(210, b'\xff\xff')))
        revolutions.first(doing=lambda: self.car.write(arduino_packet(210, b'\5\0')))
        self.assertEqual(revolutions.messages[0].data, 5)
        cliff = self.topic('mcu/cliff', Range)
        seqs = iter(range(1 << 30))

        def say(data):
            return lambda: self.sensors.write(mcu.encode_raw(0x20, next(seqs) % 256, data))
        cliff.first(lambda m: math.isnan(m.range), doing=say(b'\xff\xff'))
        message = cliff.first(lambda m: abs(m.range - 1.5) < 1e-6, doing=say(pack('H', 1500)))
        self.assertEqual((message.header.frame_id, message.radiation_type),
                         ('robot/cliff', Range.INFRARED))
        self.assertAlmostEqual(message.field_of_view, 0.44, 6)
        for data, error in ((b'\1\0\0', 'length: '), (pack('H', 2001), 'implausible: '),
                            (pack('H', 2000), '')):
            found = frames.next(lambda m, d=data: m.type == 0x20 and bytes(m.data) == d,
                                doing=say(data))
            self.assertTrue(found.error.startswith(error) and bool(error) == bool(found.error),
                            found.error)

    def test_commands_have_their_exact_bytes(self):
        several = Int16MultiArray(data=[1, -2, 3])
        several.layout.data_offset = 9
        for name, message, type_, data in (
                *(('gripper', Vector3(x, 7.0, z), 48, pack('hB', *raw)) for x, z, raw in (
                    (12.5, 0.5, (125, 128)), (-100, 0, (-1000, 0)), (100, 1, (1000, 255)))),
                ('say', String('hé'), 202, 'hé'.encode()),
                ('several', several, 203, b'\x09\0\1\xff\xfe\0\3'),
                ('third', JointState(position=[7, 8, 9]), 204, pack('h', 9))):
            topic = self.command(f'~{name}', type(message))
            self.until_on_the_wire(arduino_packet(type_, data),
                                   lambda t=topic, m=message: t.publish(m))
            topic.unregister()
        gripper = self.command('~gripper', Vector3)       # out of range: refused
        for _ in range(10):
            gripper.publish(Vector3(101, 0, 0))
        self.until_on_the_wire(arduino_packet(48, pack('hB', 990, 0)),
                               lambda: gripper.publish(Vector3(99, 0, 0)))
        self.assertNotIn(arduino_packet(48, pack('hB', 1010, 0)), self.car.wire)


class OwnFunctions(Contract):
    """Functions of the bus: services and polled topics."""

    def setUp(self):
        super().setUp()
        settle(PACKAGE, self.bus)
        self.addCleanup(settle, PACKAGE, self.bus)

    def answers(self, cmd2, reply):
        """The board answers a function with this."""
        self.bus.rule = lambda request: reply if request[:2] == (bus.FUNCTION, cmd2) else None

    def call(self, proxy, *arguments):
        """The answer to a call, which is made again if a stall kept it back."""
        return until(lambda: next((a for a in [proxy(*arguments)] if not any(
            words in a.message for words in ('nothing was sent', 'not known'))), None), 'an answer')

    def test_a_call_sends_its_request_and_returns_the_reply(self):
        pump = self.service('~pump', SetBool)
        for reply, success in ((bus.Reply(bus.OK), True), (bus.Reply(bus.ERROR, b'\2\x80'), False),
                               (bus.Reply(bus.OK, b'\1'), True)):     # data where none is expected
            self.answers(0x30, reply)
            answer = self.call(pump, True)
            self.assertEqual(answer.success, success)
            self.assertEqual(self.bus.asked(0x30)[-1], b'\1')
        self.answers(0x31, bus.Reply(bus.OK, b'half full'))
        self.assertEqual(self.call(self.service('~read_level', Trigger)).message, 'half full')

    def test_a_response_has_the_outcome_and_the_values(self):
        gentle = self.service('~gentle', Lift)
        self.answers(0x35, bus.Reply(bus.OK, b'\0'))
        answer = self.call(gentle, 1, 9)
        self.assertEqual((answer.success, answer.status, answer.error_code), (True, bus.OK, 0))
        self.assertEqual(self.bus.asked(0x35)[-1], b'\x09\1')
        answer = gentle(1, 10)
        self.assertEqual((answer.success, answer.status), (False, NOT_SENT))
        self.assertNotIn(b'\x0a\1', self.bus.asked(0x35))

    def test_without_success_a_failure_is_a_service_error(self):
        level = self.service('~level', GetLoggers)
        self.answers(0x34, bus.Reply(bus.OK, b'full'))

        def full():
            try:
                return level().loggers[0].name == 'full'
            except rospy.ServiceException as error:     # a stall kept it back
                return print(error)
        until(full, 'the reply')
        self.answers(0x34, bus.Reply(bus.ERROR, b'\0\x80'))
        self.assert_service_error('0x8000', level)
        self.answers(0x34, b'')
        self.assert_service_error('no reply', level)

    def test_replies_of_polled_functions_are_published(self):
        tank, frames = self.topic('~tank', FluidPressure), self.topic('serial_msg', SerialMsg)
        message = tank.first(lambda m: m.fluid_pressure == 101320)
        self.assertEqual((message.header.frame_id, message.variance), ('robot/tank', 10000))
        frames.first(lambda m: m.text == 'tank' and m.direction == SerialMsg.TX)
        frames.first(lambda m: m.text == 'tank OK fluid_pressure=101320')


class Announced(Contract):
    """Rows that boards announce: they appear, change and go while the bridge runs."""

    def tearDown(self):
        self.announce('')

    def announce(self, text, board=None, link='arduino', more=()):
        """Announce rows until the bridge has them, as the parameter server shows."""
        names = {line.split(':')[0] for line in text.splitlines()} - {'firmware'}
        chunks = announcement(text.encode(), 60) if text else announcement(b'#', 60)
        packets = [arduino_packet(255, chunk) if board is None else mcu.encode_raw(255, 0, chunk)
                   for chunk in chunks]
        until(lambda: set(rospy.get_param(resolved(f'~{link}/announced'), ())) == names - set(more),
              f'{names} are announced', every=0.1,
              doing=lambda: (board or self.car).write(b''.join(packets)))

    def test_topics_and_commands_appear_and_carry_values(self):
        before = names_of()
        self.announce('firmware: nano_car 1.1.0\n' + FORCE + HORN)
        self.rosout.wait_for('arduino: announces torque, horn (firmware nano_car 1.1.0)')
        self.assertEqual([after - names for after, names in zip(names_of(), before)],
                         [{resolved('~torque')}, {resolved('~horn')}, set()])
        self.topic('~torque', Float32).first(
            lambda m: abs(m.data - 12.34) < 1e-4,
            doing=lambda: self.car.write(arduino_packet(50, pack('h', 1234))))
        horn = self.command('~horn', UInt16)
        self.until_on_the_wire(arduino_packet(52, b'\1\2'), lambda: horn.publish(513))
        self.assertEqual(rospy.get_param(resolved('~arduino/announced')), {
            'torque': {'type': 50, 'ros_type': 'std_msgs/Float32', 'layout': '<h',
                       'fields': ['data'], 'scale': 0.01},
            'horn': {'type': 52, 'direction': 'to_board', 'ros_type': 'std_msgs/UInt16',
                     'layout': '<H', 'fields': ['data']}})
        self.diagnostics.wait_for('arduino', lambda status: (
            status.keys.get('firmware'), status.keys.get('announced')) == (
                'nano_car 1.1.0', 'torque, horn'), 'them')
        self.announce(LEVEL, self.sensors, 'mcu')
        self.topic('mcu/depth', UInt16).first(
            lambda m: m.data == 7, doing=lambda: self.sensors.write(mcu.encode_raw(51, 1, b'\7\0')))
        self.announce('', self.sensors, 'mcu')

    def test_what_changes_is_replaced_what_went_is_taken_down_and_nothing_else_notices(self):
        self.announce(FORCE + HORN)
        torque, ticks = self.topic('~torque', Float32), self.topic('~ticks', Ticks)

        def speak():
            self.car.write(arduino_packet(50, pack('h', 100)))
        torque.first(doing=speak)
        connections = [each._subscriber.impl.connections[:] for each in (torque, ticks)]
        self.announce(FORCE + LEVEL)
        self.assertNotIn(resolved('~horn'), names_of()[1])
        level = self.topic('~depth', UInt16)
        level.first(lambda m: m.data == 7,
                    doing=lambda: self.car.write(arduino_packet(51, b'\7\0')))
        level.close()       # rospy has one type for a name in a process
        self.announce(FORCE + LEVEL)
        until(lambda: dict(rosgraph.Master('/test').getTopicTypes())[resolved('~depth')]
              == 'std_msgs/Bool', 'another type', every=0.1,
              doing=lambda: self.announce(FORCE + LEVEL.replace('UInt16', 'Bool')))
        self.topic('~depth', Bool).first(
            lambda m: m.data is True, doing=lambda: self.car.write(arduino_packet(51, b'\7\0')))
        torque.next(lambda m: m.data == 1.0, doing=speak)
        self.assertEqual([each._subscriber.impl.connections for each in (torque, ticks)],
                         connections)
        self.announce('')
        self.assertEqual(names_of()[0] & {resolved('~torque'), resolved('~depth')}, set())
        self.diagnostics.wait_for('arduino', lambda s: s.keys['announced'] == '', 'no row')

    def test_a_row_that_may_not_be_is_left_out_and_the_others_stand(self):
        """One has the name of a parameter's row, one its type, one the name of another link's row,
        one a wrong key."""
        wrong = 'force', 'newton', 'valve', 'horn'
        self.announce(FORCE + FORCE.replace('torque', 'force').replace('50', '53')
                      + FORCE.replace('torque', 'newton').replace('50', '32')
                      + LEVEL.replace('depth', 'valve') + HORN.replace('layout', 'lay'), more=wrong)
        self.assertIn(resolved('~torque'), names_of()[0])
        for name in wrong:
            self.rosout.wait_for(name)

    def test_functions_of_a_bus_board_appear_change_and_go(self):
        settle(PACKAGE, self.bus)
        valve = self.service('~valve', SetBool)
        until(lambda: valve(True).success, 'the valve opens')
        self.assertIn(b'\1', self.bus.asked(0x40))
        self.topic('~well', Float32).first(lambda m: abs(m.data - 1.5) < 1e-6)
        for text in FIRMWARE + 'valve: {cmd2: 0x42, srv_type: std_srvs/Trigger}\n', None:
            with self.unplugged('bus'):
                self.robot.bus.close()
                self.robot.start_bus(*[text] if text else [])
            until(lambda t=text: (resolved('~well') in names_of()[0]) == (not t),
                  'the board of now')
            if text:
                changed = service(f'{NODE}/valve', Trigger)
                until(lambda c=changed: c().success, 'the valve answers', every=0.1)
                self.assertIn(b'', self.bus.asked(0x42))
        self.diagnostics.wait_for('bus', lambda s: s.keys['announced'] == 'valve, well', 'them')


class Settings(Contract):
    """Settings, by dynamic_reconfigure's own client."""

    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.name = resolved('~settings/arduino')
        cls.client = dynamic_reconfigure.client.Client(cls.name, timeout=60)
        cls.addClassCleanup(cls.client.close)

    def until_published(self, condition, what, doing=None):
        """Wait for values of the settings."""
        until(lambda: condition(self.client.get_configuration(timeout=1.0)), what, doing=doing,
              every=0.1)

    def set(self, **values):
        """Set values; return what the bridge answers. Again if a stall dropped what the board
        confirms."""
        return until(lambda: next((found for found in [self.client.update_configuration(values)]
                                   if not self.unconfirmed()), None), 'it is confirmed')

    def unconfirmed(self):
        """The settings that are not confirmed."""
        return self.diagnostics.wait_for('arduino', lambda status: True, 'keys').keys[
            'settings unconfirmed']

    def test_they_are_shown_with_limits_unit_and_description(self):
        shown = {each['name']: each for each in self.client.get_parameter_descriptions()}
        kp, ramp, reverse = (shown[name] for name in ('kp', 'ramp', 'reverse'))
        self.assertEqual((kp['type'], kp['min'], kp['max'], kp['description']),
                         ('double', 0.0, 10.0, 'proportional gain [1/s]'))
        self.assertEqual((ramp['type'], ramp['min'], ramp['max']), ('int', 0, 1000))
        self.assertEqual(reverse['type'], 'bool')

    def test_a_parameter_is_the_wanted_value_at_the_start_and_the_boards_own_stands_else(self):
        self.until_published(lambda v: (v.ramp, v.rate) == (250, 0), 'these values')
        self.assertEqual(self.unconfirmed(), '')

    def test_a_set_returns_what_the_board_confirmed(self):
        values = self.set(kp=2.25, reverse=True)
        self.assertEqual((values.kp, values.reverse, values.ramp), (2.25, True, 250))
        for data in pack('Bf', 1, 2.25), b'\3\1':
            self.assertIn(arduino_packet(253, data), self.car.wire)
        until(lambda: rospy.get_param(self.name + '/kp', None) == 2.25, 'the parameter')
        self.assertEqual(self.set(kp=9.0).kp, 5.0, 'the limit of the board')
        self.assertEqual(self.set(ramp=5000).ramp, 1000, 'the limit of the row')
        self.set(ramp=250)

    def test_a_set_while_the_port_is_closed_is_kept_until_the_board_confirms_it(self):
        with self.unplugged('arduino'):
            values = self.client.update_configuration({'kp': 1.5})
            self.assertEqual(values.kp, 1.5)
            self.assertIn('kp=1.5', self.unconfirmed())
        self.diagnostics.wait_for('arduino', lambda s: s.keys['settings unconfirmed'] == '',
                                  'all confirmed')
        self.assertIn(arduino_packet(253, pack('Bf', 1, 1.5)), self.car.wire)

    def test_settings_come_and_go_with_an_announcement(self):
        before = set(self.client.get_configuration())

        def announce(text):
            return lambda: [self.car.write(arduino_packet(255, chunk))
                            for chunk in announcement(text, 60)]
        self.until_published(lambda v: 'gain' in v, 'gain comes',
                             announce(GAIN.encode()))
        self.assertEqual(self.set(gain=8).gain, 8)
        self.assertIn(arduino_packet(253, b'\7\x08'), self.car.wire)
        self.until_published(lambda v: set(v) == before, 'gain goes', announce(b'#'))
