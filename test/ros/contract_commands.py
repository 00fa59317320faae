"""Subscribed, services, ~stop: the exact bytes of every command and call, their outcomes, and what
is refused."""
import itertools
import re
import threading
import time
from contextlib import contextmanager

import rospy
from geometry_msgs.msg import Twist, Vector3
from std_msgs.msg import Bool, String
from std_srvs.srv import Empty, SetBool, Trigger

from boards import (NODE, NOT_SENT, PACKAGE, SPEED_0_PACKET, SYNC_FRAME, TIMEOUT, WARN,
                    Waiter, settle, until)
from by_definition import CALIBRATION, LED, SPEED, STEERING, arduino_packet, bus_frame
from contract_robot import Contract, pack
from publishers import FakePublisher
from serial_communication.boards.bus import wire as bus
from serial_communication.msg import SpeedPWMCommand, SteeringPWMCommand
from serial_communication.srv import (BusRequest, GetEnvironment, Gimbal, GimbalRequest, Lift,
                                      LiftRequest)

STOPPED = 'stopped: call ~stop with data: false'
CALIBRATION_PACKET = arduino_packet(CALIBRATION)
DRIVES, STANDS = (arduino_packet(205, pack('hh', *raws)) for raws in ((500, -100), (0, 0)))


class Commands(Contract):
    """Topics to the car."""

    def test_commands_have_their_exact_bytes(self):
        for name, kind, type_, value, data in (
                ('~speed', SpeedPWMCommand, SPEED, 400, pack('h', 400)),
                ('~speed', SpeedPWMCommand, SPEED, 1001, pack('h', 1000)),
                ('~speed', SpeedPWMCommand, SPEED, -32768, pack('h', -1000)),
                ('~steering', SteeringPWMCommand, STEERING, 1500, pack('H', 1500)),
                ('~steering', SteeringPWMCommand, STEERING, 65535, b'\xff\xff')):
            topic = self.command(name, kind)
            self.until_on_the_wire(arduino_packet(type_, data), lambda t=topic, v=value: t.publish(
                value=v))
            topic.unregister()
        led = self.command('~led', String)
        refused = 'x' * 31, 'hé'
        for text in refused * 10:
            led.publish(text)
        for text in 'x' * 30, 'left':
            self.until_on_the_wire(arduino_packet(LED, text.encode() + b'\0'),
                                   lambda t=text: led.publish(t))
        for text in refused:
            self.assertNotIn(arduino_packet(LED, text.encode() + b'\0'), self.car.wire)

    def test_a_speed_that_is_not_renewed_ends_in_speed_0(self):
        speed = self.command('~speed', SpeedPWMCommand)
        until(lambda: self.car.motor_on, 'the car drives', doing=lambda: speed.publish(value=300))
        until(lambda: self.car.speeds[-1] == 0, 'SPEED 0')
        self.assertFalse(self.car.motor_on)

    def test_heartbeats_have_the_configured_rate(self):
        def measured():
            self.car.forget()
            self.car.wait_for_heartbeats(40)
            stamps = self.car.heartbeat_times
            rate = (len(stamps) - 1) / (stamps[-1] - stamps[0])
            return 30 < rate < 60 or print(rate)
        until(measured, 'heartbeats at 50 Hz')

    def test_a_motion_is_saturated(self):
        topic, command = self.command('~cmd_vel', Twist), Twist()
        command.linear.x, command.angular.z = 0.7, -9.0
        self.until_on_the_wire(arduino_packet(205, pack('hh', 600, -600)),
                               lambda: topic.publish(command))
        self.until_on_the_wire(STANDS, lambda: None)       # its publisher has stopped


class Age(Contract):
    """Commands that may be old, by their stamps or their connections."""

    def publisher(self, name='/driver', **more):
        """A publisher of ~speed, until the test ends."""
        made = FakePublisher(name, f'{NODE}/speed', SpeedPWMCommand, **more)
        self.addCleanup(made.close)
        return made.connected()

    @staticmethod
    def speed(value, ago=0.0):
        """A command with a stamp so many seconds ago."""
        command = SpeedPWMCommand(value=value)
        command.header.stamp = rospy.Time.now() - rospy.Duration(ago)
        return command

    def drive(self, publisher, value):
        """Publish a speed until the car has it."""
        until(lambda: value in self.car.speeds, f'speed {value}', every=0.1,
              doing=lambda: publisher.say(self.speed(value)))

    def test_a_command_is_refused_by_its_stamp_but_a_zero_is_not(self):
        driver = self.publisher()
        self.drive(driver, 309)
        for value, ago in ((301, 1.0), (302, -40.0), (303, 3600.0)):
            driver.say(self.speed(value, ago))
        self.drive(driver, 310)
        self.assertFalse({301, 302, 303} & set(self.car.speeds))

        def stops():
            self.car.forget()
            self.drive(driver, 311)
            driver.say(self.speed(0, 3600.0))
            until(lambda: self.car.speeds[-1] == 0, 'SPEED 0')
            driven, zero = self.car.command_frames[-2:]
            return zero.stamp - driven.stamp < 0.4       # before the timeout of the speed
        until(stops, 'a zero counts whatever its stamp is')

    def test_of_a_publishers_connections_only_the_newest_counts(self):
        old = self.publisher()
        self.drive(old, 300)
        new = self.publisher()
        self.drive(new, 400)
        new.connections[-1].close()
        for _ in range(30):
            old.say(self.speed(301))
            time.sleep(0.01)
        self.drive(self.publisher(), 401)
        self.assertNotIn(301, self.car.speeds)

    def test_a_latched_command_is_taken_once(self):
        """From a publisher that has just appeared, but not from one whose name is known."""
        numbers = itertools.count()

        def taken():
            name, command = f'/typist_{next(numbers)}', SpeedPWMCommand(value=320)
            self.publisher(name, latching=True, latched=command)
            driver = self.publisher()
            self.drive(driver, 330)     # then it has arrived, or is refused after a stall
            return 320 in self.car.speeds and name
        name = until(taken, 'what is latched')
        again = self.publisher(name, latching=True, latched=SpeedPWMCommand(value=321))
        self.drive(again, 322)
        self.assertNotIn(321, self.car.speeds)


class Services(Contract):
    """The services of the bus, and the calibration."""

    def setUp(self):
        super().setUp()
        self.lift, self.gimbal = self.service('~lift', Lift), self.service('~gimbal', Gimbal)
        self.request = self.service('~bus/request', BusRequest)
        self.environment = self.service('~get_environment', GetEnvironment)

    def test_calls_have_their_exact_bytes(self):
        for call, arguments, frame in (
                (self.lift, (LiftRequest.UP, 100), 'a50255200064b6'),
                (self.lift, (LiftRequest.DOWN, 255), 'a502552001ff2c'),
                (self.gimbal, (GimbalRequest.LEFT, 90), 'a5025521005a89'),
                (self.gimbal, (GimbalRequest.RIGHT, 90), 'a5025521015a88'),
                (self.gimbal, (GimbalRequest.UP, 90), 'a5025521025a8b'),
                (self.gimbal, (GimbalRequest.DOWN, 90), 'a5025521035a8a'),
                (self.environment, (), 'a5025522d0'),
                (self.request, (0x55, 0x30, b'\x07'), 'a501553007c6')):
            answer = self.answered(call, *arguments)
            self.assertTrue(answer.success)
            self.assertIn(bytes.fromhex(frame), self.bus.raws)
        self.assertEqual(self.bus.asked(0x30), [b'\x07'])
        answer = self.answered(self.request, 0x0F, 0, b'', status=bus.ERROR)
        self.assertEqual((answer.success, answer.error_code), (False, 0x8000))
        self.assertIn(bytes.fromhex('a5000f00aa'), self.bus.raws)
        until(lambda: bytes(self.bus.wire) == b''.join(self.bus.raws), 'only frames are sent')

    def test_the_answer_tells_the_outcome(self):
        for reply, status, code in (
                (bus.Reply(bus.OK), bus.OK, 0),
                (bus.Reply(bus.ERROR, b'\2\x80'), bus.ERROR, 0x8002),
                (bus.Reply(bus.INVALID, b'\x20'), bus.INVALID, 0x20), (b'', TIMEOUT, 0)):
            answer = self.answered(self.lift, 0, 10, reply=reply, status=status)
            self.assertEqual((answer.success, answer.error_code), (status == bus.OK, code))
            self.assertRegex(answer.message, r'^\S.*\Z')
            self.assertEqual(self.bus.asked(bus.LIFT), [b'\0\x0a'])
        answer = self.answered(self.lift, 2, 10, status=NOT_SENT)
        self.assertFalse(answer.success)
        self.assertEqual(self.bus.asked(bus.LIFT), [])
        answer = self.answered(self.request, 0x55, 0x36, b'', cmd2=0x36,
                               reply=bus.Reply(bus.OK, b'\1\2\3'))
        self.assertEqual(answer.data, b'\1\2\3')

    def test_echo_tells_the_milliseconds_and_sync_synchronises(self):
        echo, sync = self.service('~bus/echo', Trigger), self.service('~bus/sync', Trigger)

        def timed():
            began, answer = time.monotonic(), echo()
            return answer.success and (answer.message, (time.monotonic() - began) * 1e3)
        message, took = until(timed, 'an echo')
        self.assertTrue(0 < float(re.match(r'(\d+\.?\d*) ms$', message).group(1)) < took)

        def sent():
            settle(PACKAGE, self.bus)
            return sync().success and SYNC_FRAME in self.bus.raws
        until(sent, 'SYNC')
        self.bus.rule = lambda request: b'' if request.cmd1 == bus.SYNC else None
        self.assertFalse(sync().success)
        settle(PACKAGE, self.bus)

    def test_every_service_answers_at_once_when_the_port_is_gone(self):
        speed = self.command('~speed', SpeedPWMCommand)
        with self.unplugged('bus', 'arduino'):
            for call, *arguments in (
                    (self.lift, 0, 1), (self.gimbal, 0, 1), (self.environment,),
                    (self.request, 0x55, 0x30, b''), (self.service('~bus/echo', Trigger),),
                    (self.service('~bus/sync', Trigger),)):
                answer = Waiter(call, *arguments).result()
                self.assertFalse(answer.success)
                self.assertIn('closed', answer.message)
                self.assertEqual(getattr(answer, 'status', NOT_SENT), NOT_SENT)
            self.assert_service_error('closed', self.service('~calibrate_imu', Empty))
            for _ in range(10):
                speed.publish(value=345)
        until(lambda: self.lift(0, 1).success, 'the lift answers')
        until(lambda: 346 in self.car.speeds, 'the car drives', every=0.05,
              doing=lambda: speed.publish(value=346))
        self.assertNotIn(345, self.car.speeds)

    def test_a_calibration_stops_the_car_and_blocks_commands_until_it_ends(self):
        calibrating = self.topic('~imu/calibrating', Bool)
        self.assertFalse(calibrating.first().data)         # latched
        speed, steering, led = (self.command(f'~{name}', kind) for name, kind in (
            ('speed', SpeedPWMCommand), ('steering', SteeringPWMCommand), ('led', String)))
        calibrate = self.service('~calibrate_imu', Empty)

        def begins():
            self.car.forget()
            until(lambda: self.car.motor_on, 'it drives', doing=lambda: speed.publish(value=200))
            try:
                calibrate()
            except rospy.ServiceException:      # after a stall
                return False
            until(lambda: CALIBRATION_PACKET in self.car.wire, 'it calibrates')
            return True
        until(begins, 'the calibration')
        calibrating.first(lambda m: m.data)
        self.assertTrue(self.topic('~imu/calibrating', Bool).first().data)
        self.diagnostics.wait_for('arduino', lambda status: status.keys['condition']
                                  == 'calibrating', 'condition calibrating')
        before = self.car.wire.partition(CALIBRATION_PACKET)[0]
        self.assertGreater(before.rfind(SPEED_0_PACKET), before.rfind(
            arduino_packet(SPEED, pack('h', 200))))
        self.assert_service_error('calibrates', calibrate)
        for _ in range(10):
            speed.publish(value=500)
            steering.publish(value=1000)
            led.publish('brake')
        until(lambda: not calibrating.messages[-1].data, 'it is over')
        self.until_on_the_wire(arduino_packet(STEERING, pack('H', 1234)),
                               lambda: steering.publish(value=1234))
        after = self.car.wire.partition(CALIBRATION_PACKET)[2]
        for type_, data in ((SPEED, pack('h', 500)), (STEERING, pack('H', 1000)),
                            (LED, b'brake\0')):
            self.assertNotIn(arduino_packet(type_, data), after)


class Stop(Contract):
    """~stop, while another program drives."""

    def setUp(self):
        super().setUp()
        self.stop = self.service('~stop', SetBool)
        self.addCleanup(self.release)

    def release(self):
        """End a stop; refused after a stall."""
        until(lambda: self.stop(False).success, 'the stop is released', every=0.1)

    @contextmanager
    def driving(self):
        """Publish a Twist at 20 Hz, and have it on the wire when the block begins."""
        topic, command, ended = self.command('~cmd_vel', Twist), Twist(), threading.Event()
        command.linear.x, command.angular.z = 0.5, -0.1

        def drive():
            while not ended.wait(0.05):
                topic.publish(command)
        thread = threading.Thread(target=drive)
        thread.start()
        try:
            self.until_on_the_wire(DRIVES, lambda: None)
            yield
        finally:
            ended.set()
            thread.join()

    def test_a_stop_holds_while_another_program_drives_until_it_is_released(self):
        gripper, led = self.command('~gripper', Vector3), self.command('~led', String)
        steering = self.command('~steering', SteeringPWMCommand)
        settle(PACKAGE, self.bus)
        with self.driving():
            answer = self.stop(True)
            self.car.forget()
            self.assertTrue(answer.success, answer.message)
            halt = bus_frame(b'\x55\x2f', b'')
            until(lambda: halt in self.bus.raws, 'the function that interrupts')
            until(lambda: self.car.wire.count(STANDS) > 3, 'zeros')
            for _ in range(10):
                gripper.publish(Vector3(1, 0, 0))
            self.until_on_the_wire(arduino_packet(LED, b'brake\0'), lambda: led.publish('brake'))
            self.until_on_the_wire(arduino_packet(STEERING, pack('H', 1600)),
                                   lambda: steering.publish(value=1600))
            self.car.wait_for_heartbeats(50)
            # What was under way is read before the first zero.
            self.assertNotIn(DRIVES, self.car.wire.partition(STANDS)[2])
            self.assertNotIn(arduino_packet(48, pack('hB', 10, 0)), self.car.wire)
            for name, kind, arguments in (('~lift', Lift, (0, 10)), ('~gimbal', Gimbal, (0, 10)),
                                          ('~bus/request', BusRequest, (0x55, 0x30, b'')),
                                          ('~pump', SetBool, (True,))):
                refused = self.service(name, kind)(*arguments)
                self.assertFalse(refused.success)
                self.assertIn(STOPPED, refused.message)
                self.assertEqual(getattr(refused, 'status', NOT_SENT), NOT_SENT)
            self.assert_service_error(STOPPED, self.service('~calibrate_imu', Empty))
            self.answered_reading()
            for link in 'bus', 'arduino':
                status = self.diagnostics.wait_for(
                    link, lambda status: status.keys['condition'] == 'stopped', 'stopped')
                self.assertEqual(status.level, WARN)
            self.release()
            self.until_on_the_wire(DRIVES, lambda: None)
        for cmd2 in bus.LIFT, bus.GIMBAL, 0x30:
            self.assertEqual(self.bus.asked(cmd2), [])
        self.diagnostics.wait_for('bus', lambda status: status.keys['condition'] == 'ok', 'ok')

    def answered_reading(self):
        """A reading is not refused."""
        reading = self.service('~get_environment', GetEnvironment)
        until(lambda: reading().success, 'a reading')

    def test_it_holds_for_a_port_that_is_closed_too(self):
        with self.unplugged('arduino'):
            self.assertFalse(self.stop(True).success)
        speed = self.command('~speed', SpeedPWMCommand)
        steering = self.command('~steering', SteeringPWMCommand)
        for _ in range(10):
            speed.publish(value=77)
        self.until_on_the_wire(arduino_packet(STEERING, pack('H', 1601)),
                               lambda: (speed.publish(value=77), steering.publish(value=1601)))
        self.assertNotIn(77, self.car.speeds)
