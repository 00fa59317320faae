"""Published: every topic with its type, its exact values, its frame id and its stamp; tf."""
import time
from math import inf, isnan, nan, sqrt

import rospy
import rosservice
from diagnostic_msgs.msg import DiagnosticArray
from dynamic_reconfigure.srv import Reconfigure
from geometry_msgs.msg import Vector3Stamped
from rosgraph import Master
from sensor_msgs.msg import Imu, MagneticField, Range, RelativeHumidity, Temperature
from std_msgs.msg import Bool, String
from std_srvs.srv import Empty, SetBool, Trigger
from tf2_msgs.msg import TFMessage

from boards import level_imu, names_of, ranges, until, values_of
from by_definition import arduino_packet
from contract_robot import Contract, pack, resolved
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.mcu import wire as mcu
from serial_communication.msg import (Environment, McuStatus, McuStatus2, SerialMsg,
                                      SpeedPWMCommand, SteeringFeedback, SteeringPWMCommand, Ticks,
                                      Voltage)
from serial_communication.srv import BusRequest, GetEnvironment, Gimbal, Lift, Release

HALF = sqrt(0.5)
# By link: what it publishes, subscribes to and serves; '' has what any bridge does.
PUBLISHED = {
    '': {'serial_msg': SerialMsg, 'diagnostics': DiagnosticArray, 'tf_static': TFMessage},
    'bus': {'~environment': Environment, '~environment/temperature': Temperature,
            '~environment/humidity': RelativeHumidity},
    'arduino': {'~imu': Imu, '~imu/temperature': Temperature, '~imu/calibrating': Bool,
                '~voltage': Voltage, '~ticks': Ticks, '~steering_angle': SteeringFeedback},
    'mcu': {'mcu/status': McuStatus2, 'mcu/adc_status': McuStatus, 'mcu/imu': Imu,
            'mcu/range_1': Range, 'mcu/range_2': Range},
    'contract': {'tf': TFMessage, 'wind': Vector3Stamped}}
SUBSCRIBED = {'arduino': {'~speed': SpeedPWMCommand, '~steering': SteeringPWMCommand,
                          '~led': String}}
SERVICES = {
    '': {'~stop': SetBool},
    'bus': {'~lift': Lift, '~gimbal': Gimbal, '~get_environment': GetEnvironment,
            '~bus/request': BusRequest, '~bus/echo': Trigger, '~bus/sync': Trigger},
    'arduino': {'~calibrate_imu': Empty},
    'contract': {'~settings/arduino/set_parameters': Reconfigure}}
for _link in 'bus', 'arduino', 'mcu', 'wind':
    SERVICES.setdefault(_link, {}).update({
        f'~{_link}/reset': Trigger, f'~{_link}/release': Release})
OF_ROS = 'rosout', 'clock', '~get_loggers', '~set_logger_level'
GOT = 'connected', 'valid', 'seq', 'vl53_1', 'vl53_2'
XYZW = 'x', 'y', 'z', 'w'
# A packet of a real board; the norm of its quaternion is far from 1.
IMU_PACKET = bytes.fromhex('05092d41e00210020801040affec021e0564ff382003faf600')
SENSOR_FRAME = bytes.fromhex('020c109c2f003a0000000dfff3009803')     # SEQ 156
ADC_FRAME = bytes.fromhex('020e01ea000000000f0000001f0290006903')    # SEQ 234


def all_of(table):
    """The names and types in a table."""
    return [item for each in table.values() for item in each.items()]


class Names(Contract):
    """The tables of the contract, and the rows of the parameters."""

    def rows(self, key, wanted):
        """The ROS type of each row that has the key and what is wanted, by its resolved name."""
        given = self.robot.parameters
        rows = [('~', given['arduino']['messages']), ('mcu/', given['mcu']['messages']),
                ('~', given['bus']['functions'])]
        return {resolved(prefix + name): row[key] for prefix, group in rows
                for name, row in group.items() if key in row and wanted(row)}

    def assert_has(self, names, table, rows, *more):
        """These are the names of this table, of these rows, and more."""
        expected = {name for name, _kind in all_of(table)}.union(more)
        self.assertEqual(names - set(map(resolved, OF_ROS)),
                         set(map(resolved, expected)).union(rows))

    def test_the_bridge_has_these_names_and_no_others(self):
        published, subscribed, served = names_of()
        from_board = self.rows('ros_type', lambda row: row.get('direction') != 'to_board')
        self.assert_has(published, PUBLISHED, from_board, '~well',
                        '~settings/arduino/parameter_descriptions',
                        '~settings/arduino/parameter_updates')
        to_board = self.rows('ros_type', lambda row: row.get('direction') == 'to_board')
        self.assert_has(subscribed, SUBSCRIBED, to_board)
        functions = self.rows('srv_type', lambda row: True)
        self.assert_has(served, SERVICES, functions, '~valve')
        types = dict(Master('/test').getTopicTypes())
        for name, kind in all_of(PUBLISHED) + all_of(SUBSCRIBED):
            self.assertEqual(types[resolved(name)], kind._type, name)
        for name, kind in all_of(SERVICES):
            self.assertEqual(rosservice.get_service_type(resolved(name)), kind._type, name)
        for name, ros_type in {**from_board, **to_board}.items():
            self.assertEqual(types[name], ros_type)
        for name, srv_type in functions.items():
            self.assertEqual(rosservice.get_service_type(name), srv_type)


class Published(Contract):
    """Boards that measure, and what a test sends beside it."""

    def stamped(self, topic, stamp, condition=lambda message: True):
        """The message with this stamp that meets a condition: frames of one read have one stamp."""
        return topic.first(lambda m: m.header.stamp == stamp and condition(m),
                           what=f'has what was read at {stamp}')

    def test_every_topic_carries_data_with_a_frame_and_a_stamp_of_now(self):
        began = rospy.Time.now()
        frames = {'~imu': 'car_imu', '~imu/temperature': 'car_imu', '~environment': 'trunk',
                  '~environment/temperature': 'trunk', '~environment/humidity': 'trunk',
                  'mcu/imu': 'head', 'mcu/range_1': 'front', 'mcu/range_2': 'rear', 'wind': 'wind'}
        topics = {name: self.topic(name, kind) for name, kind in all_of(PUBLISHED)}
        wind = b'$WIMWV,090.0,R,012.5,M,A*2F\r\n'
        with open(self.robot.lines['wind'].far, 'wb', buffering=0) as sensor:
            for name, topic in topics.items():
                message = topic.first(doing=lambda: (
                    self.sensors.say(mcu.AdcStatus(1, 2, 3, 4, 5, 6)), sensor.write(wind)))
                if name in frames:
                    self.assertEqual(message.header.frame_id, f'robot/{frames[name]}')
                if name not in ('imu/calibrating', 'tf', 'tf_static') and message._has_header:
                    self.assertLessEqual(began, message.header.stamp)
                    self.assertLessEqual(message.header.stamp, rospy.Time.now())

    def test_values_of_the_car(self):
        over_100 = arduino_packet(10, pack('f', 200)).hex()     # its plausibility is not checked
        for name, kind, packet, value in (
                ('~voltage', Voltage, '060acdcc6c4100', 14.8), ('~voltage', Voltage, over_100, 200),
                ('~ticks', Ticks, '03080700', 7),
                ('~steering_angle', SteeringFeedback, '0207020200', 512)):
            self.topic(name, kind).first(
                lambda m, v=value: abs(m.value - v) < 1e-5, what=f'is {value}',
                doing=lambda p=packet: self.car.write(bytes.fromhex(p)))

    def test_an_imu_packet_has_the_axes_units_and_covariances_of_ros(self):
        imu, temperature = self.topic('~imu', Imu), self.topic('~imu/temperature', Temperature)
        for packet, turn, rate, acceleration, warm in (
                # Quaternion w x y z: 1/2 each, with signs; 1 g along the board's x.
                (arduino.encode(arduino.Imu(8192, 8192, -8192, 8192, 100, 200, 300, 8192, 4096,
                                            -8192, 3400)),
                 (-0.5, -0.5, 0.5, 0.5), (0.2, -0.1, 0.3), (4.905, -9.81, -9.81), 46.53),
                (IMU_PACKET, (0.25, 0.5, 0.125, 0.70709228515625), (-0.020, -0.010, 0.030),
                 (-0.239501953125, -0.1197509765625, 9.81), 32.735882352941175)):
            message = imu.first(lambda m, t=turn: values_of(m.orientation, *XYZW) == t,
                                doing=lambda p=packet: self.car.write(p))
            self.assert_values(values_of(message.angular_velocity, *XYZW[:3]), rate)
            self.assert_values(values_of(message.linear_acceleration, *XYZW[:3]), acceleration)
            self.stamped(temperature, message.header.stamp,
                         lambda m, w=warm: abs(m.temperature - w) < 1e-6)
        for matrix, diagonal in ((message.linear_acceleration_covariance, (0.01, 0.01, 0.01)),
                                 (message.angular_velocity_covariance, (0.04, 0.04, 0.04)),
                                 (message.orientation_covariance, (0.09, 0.09, 0.16))):
            self.assert_values(matrix[::4], diagonal)
            self.assertEqual([matrix[index] for index in (1, 2, 3, 5, 6, 7)], [0.0] * 6)

    def test_a_fresh_reading_is_published_in_the_units_of_each_topic(self):
        topics = [self.topic(f'~environment{name}', kind) for name, kind in (
            ('', Environment), ('/temperature', Temperature), ('/humidity', RelativeHumidity))]
        self.addCleanup(setattr, self.bus, 'air', self.bus.air)
        for air in bus.Environment(65535, -12.5, 48.12), bus.Environment(351, 25.63, 100.0):
            self.bus.air = air
            answer = self.answered(self.service('~get_environment', GetEnvironment))
            stamp = answer.environment.header.stamp
            message, temperature, humidity = (self.stamped(topic, stamp) for topic in topics)
            for reading in answer.environment, message:
                self.assertEqual(reading.smoke, air.smoke)
                self.assert_values((reading.temperature, reading.humidity), air[1:], 5)
            self.assertAlmostEqual(temperature.temperature, air.temperature, 5)
            self.assertAlmostEqual(humidity.relative_humidity, air.humidity / 100, 6)

    def test_a_sensor_status_and_an_adc_status_have_the_values_of_the_frame(self):
        status, adc = self.topic('mcu/status', McuStatus2), self.topic('mcu/adc_status', McuStatus)
        message = status.first(lambda m: m.seq == 156 and m.vl53_1 == 47,
                               doing=lambda: self.sensors.write(SENSOR_FRAME))
        self.assertEqual(values_of(message, *GOT), (True, True, 156, 47, 58))
        self.assert_values(values_of(message, 'yaw', 'pitch', 'roll'), (0.0, -2.43, 2.43), 5)
        self.assertTrue(0.0 <= message.last_frame_age_sec < 1.0)
        damaged = bytes((*SENSOR_FRAME[:-2], 0, 3))
        count = message.crc_error_count
        status.first(lambda m: m.crc_error_count > count, doing=lambda: self.sensors.write(damaged))
        message = adc.first(lambda m: m.seq == 234, doing=lambda: self.sensors.write(ADC_FRAME))
        self.assertEqual(values_of(message, 'connected', 'valid'), (True, True))
        self.assertEqual(values_of(message, *(f'adc{channel}' for channel in range(6))),
                         (0, 0, 15, 0, 543, 144))

    def test_ranges_follow_rep_117_and_angles_become_an_orientation(self):
        """What one frame says is in messages with one stamp."""
        status, imu = self.topic('mcu/status', McuStatus2), self.topic('mcu/imu', Imu)
        both = [self.topic(f'mcu/range_{number}', Range) for number in (1, 2)]
        for raws, metres, angles, turn in (
                ((470, 100), (0.47, 0.1), (90.0, 0.0, 0.0), (0.0, 0.0, HALF, HALF)),
                ((8100, 99), (8.1, -inf), (0.0, 90.0, 0.0), (0.0, HALF, 0.0, HALF)),
                ((8101, 0xFFFF), (inf, nan), (0.0, 0.0, 90.0), (HALF, 0.0, 0.0, HALF)),
                ((99, 8190), (-inf, inf), (90.0, 90.0, 0.0), (-0.5, 0.5, 0.5, 0.5)),
                ((0xFFFF, 470), (nan, 0.47), (nan, nan, nan), None)):
            sent = ranges(*raws, *angles)
            found = status.first(
                lambda m, s=sent: (m.vl53_1, m.vl53_2, m.pitch) == s[:2] + s[3:4]
                or isnan(s.pitch) and isnan(m.pitch) and m.vl53_2 == s[1],
                what=f'has {sent}', doing=lambda s=sent: self.sensors.say(s))
            self.assertEqual(found.valid, 0xFFFF not in raws)
            for topic, wanted in zip(both, metres):
                message = self.stamped(topic, found.stamp, lambda m, w=wanted: (
                    isnan(m.range) if isnan(w) else m.range == w or abs(m.range - w) < 1e-6))
                self.assert_values(values_of(message, 'min_range', 'max_range', 'field_of_view'),
                                   (0.1, 8.1, 0.2))
                self.assertEqual(message.radiation_type, Range.INFRARED)
            if turn:
                message = self.stamped(imu, found.stamp, lambda m, t=turn: all(
                    abs(a - b) < 1e-6 for a, b in zip(values_of(m.orientation, *XYZW), t)))
                self.assert_values(message.orientation_covariance[::4], (0.09, 0.09, 0.16))
                self.assertEqual(message.angular_velocity_covariance[0], -1.0)
                self.assertEqual(message.linear_acceleration_covariance[0], -1.0)

        def without_angles():
            """The stamps of reads that had only frames without angles."""
            self.sensors.say(sent)
            unknown = {isnan(m.pitch): set() for m in status.messages}
            for m in list(status.messages):
                unknown[isnan(m.pitch)].add(m.stamp)
            return unknown.get(True, set()) - unknown.get(False, set())
        stamps = until(without_angles, 'a frame without angles', every=0.07)
        imu.next()      # those of earlier frames have been received
        self.assertFalse(stamps & {m.header.stamp for m in imu.messages})

    def test_a_silent_board_has_a_status_once_a_second_that_says_so(self):
        status, adc = self.topic('mcu/status', McuStatus2), self.topic('mcu/adc_status', McuStatus)
        adc.first(lambda m: m.connected, doing=lambda: self.sensors.write(ADC_FRAME))
        self.sensors.close()
        status.first(lambda m: not m.connected)
        status.forget()
        until(lambda: len(status.messages) >= 3, 'three reports')
        for message in status.messages:
            self.assertEqual(values_of(message, 'connected', 'valid', 'vl53_1', 'vl53_2'),
                             (False, False, 65535, 65535))
            self.assertTrue(all(map(isnan, values_of(message, 'yaw', 'pitch', 'roll'))))
        ages = [message.last_frame_age_sec for message in status.messages]
        self.assertGreater(ages[0], 0.49)
        self.assertGreater(ages[2] - ages[0], 1.5)
        quiet = adc.first(lambda m: not m.connected)
        self.assertFalse(quiet.valid)
        self.assertEqual(values_of(quiet, *(f'adc{channel}' for channel in range(6))), (65535,) * 6)
        self.robot.start_sensors()
        status.first(lambda m: m.connected and m.valid)


class BoardTime(Contract):
    """Boards that send their clocks: stamps are of the measurement."""

    LATE_IMU = arduino.Imu(0, 0, 0, 16384, 0, 0, 0, 0, 0, 8192, -12420)     # turned by 180°, 0 °C
    # What is sent late has other values than what is sent in time.
    LATE = (
        ('~imu', Imu, lambda m: m.orientation.z == 1),
        ('~imu/temperature', Temperature, lambda m: abs(m.temperature) < 0.01),
        ('~ticks', Ticks, lambda m: m.value == 231), ('~voltage', Voltage, lambda m: m.value == 13),
        ('~steering_angle', SteeringFeedback, lambda m: m.value == 777),
        ('~timed', MagneticField, lambda m: m.magnetic_field.x == 7),
        ('mcu/imu', Imu, lambda m: m.orientation.z > 0.9999),
        ('mcu/range_1', Range, lambda m: abs(m.range - 1.234) < 1e-6),
        ('mcu/range_2', Range, lambda m: abs(m.range - 2.345) < 1e-6),
        ('mcu/status', McuStatus2, lambda m: m.vl53_1 == 1234),
        *(('tf', TFMessage, lambda m, child=child: m.transforms[0].transform.rotation.z > 0.9999
           and m.transforms[0].child_frame_id == f'robot/{child}')
          for child in ('car_attitude', 'head_attitude')))

    def say(self, measured, car, field, sensors):
        """The boards send what they have measured at this time."""
        micros = round(measured * 1e6) % 2 ** 32
        self.car.say(arduino.Time(micros, len(car)), *car)
        self.car.write(arduino.encode_raw(213, pack('Ih', micros, field)))
        self.sensors.say(mcu.Time(micros), sensors)

    def test_all_topics_have_the_stamp_of_the_measurement(self):
        """The boards send what they have just measured, and then what they measured 0.5 s ago."""
        topics = [(self.topic(name, kind), is_late) for name, kind, is_late in self.LATE]

        def stamped():
            """Whether all that was sent late has the time when it was measured."""
            for _ in range(5):
                self.say(time.monotonic(), [level_imu()], 5, ranges())
                time.sleep(0.05)
            measured, at = time.monotonic(), rospy.Time.now().to_sec()
            time.sleep(0.5)
            self.say(measured, [self.LATE_IMU, arduino.Ticks(231), arduino.Voltage(13),
                                arduino.SteeringAngle(777)], 7, ranges(1234, 2345, 180))
            late = [topic.first(is_late) for topic, is_late in topics]
            for topic, _ in topics:
                topic.forget()
            stamps = [m.transforms[0].header.stamp if hasattr(m, 'transforms') else
                      m.header.stamp if m._has_header else m.stamp for m in late]
            return all(abs(stamp.to_sec() - at) < 0.1 for stamp in stamps)
        until(stamped, 'stamps of 0.5 s before')
        keys = self.diagnostics.wait_for('arduino', lambda status: True, 'keys').keys
        self.assertLessEqual({'board clock [ppm]', 'read delay p50 [ms]', 'read delay max [ms]'},
                             set(keys))


class Transforms(Contract):
    """/tf and /tf_static."""

    def transform(self, topic, child, doing=None, near=None):
        """Wait for the transform of this frame; with `near`, for one with this rotation."""
        def find():
            return [t for m in list(topic.messages) for t in m.transforms
                    if t.child_frame_id == f'robot/{child}' and (near is None or all(
                        abs(got - wanted) < 1e-6 for got, wanted in zip(
                            values_of(t.transform.rotation, *XYZW), near)))]
        return until(find, f'{child} on {topic.name}', doing=doing)[-1]

    def assert_transform(self, found, parent, translation, rotation):
        self.assertEqual(found.header.frame_id, f'robot/{parent}')
        self.assert_values(values_of(found.transform.translation, *XYZW[:3]), translation)
        self.assert_values(values_of(found.transform.rotation, *XYZW), rotation)

    def test_the_mounts_have_the_configured_positions(self):
        topic = self.topic('tf_static', TFMessage)
        for child, translation, rotation in (
                ('car_imu', (0.1, -0.2, 0.3), (0, 0, HALF, HALF)),
                ('head', (0, 0, 1), (1, 0, 0, 0)),
                ('front', (0.5, 0, 0), (0, HALF, 0, HALF)),
                ('rear', (0, 0, 0), (0, 0, 0, 1))):
            self.assert_transform(self.transform(topic, child), 'trunk', translation, rotation)

    def test_the_measured_orientations_are_children_of_their_sensors(self):
        topic, began = self.topic('tf', TFMessage), rospy.Time.now()
        turned = arduino.Imu(8192, 8192, -8192, 8192, 0, 0, 0, 0, 0, 8192, 0)
        not_1 = arduino.Imu(16000, 0, 0, 0, 0, 0, 0, 0, 0, 8192, 0)      # tf2 needs it normalised
        for child, parent, say, sent, near in (
                ('car_attitude', 'car_imu', self.car.say, turned, (-0.5, -0.5, 0.5, 0.5)),
                ('car_attitude', 'car_imu', self.car.say, not_1, (0, 0, 0, 1)),
                ('head_attitude', 'head', self.sensors.say, ranges(yaw=90.0), (0, 0, HALF, HALF))):
            found = self.transform(topic, child, lambda: say(sent), near)
            self.assert_transform(found, parent, (0, 0, 0), near)
            self.assertLessEqual(began, found.header.stamp)
