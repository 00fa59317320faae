#!/usr/bin/python3
"""The bridge with real firmware on emulated microcontrollers, end to end.

The tests check the effect of commands in the emulated world (registers, pins, steps), and the
effect of the world on the topics. They measure time in emulated seconds.
"""
import os
import shutil
import signal
import socket
import subprocess
import unittest
from xmlrpc.client import ServerProxy

import rosgraph
import rospy
import rostest
from sensor_msgs.msg import Imu
from std_msgs.msg import Bool, UInt16
from std_srvs.srv import Trigger

from avr_boards import OnBoard, transforms_with, until_announced, upward
from board_ends import angle_between, from_euler
from boards import (NOT_SENT, Output, PACKAGE, PATIENCE, TIMEOUT, Topic, Waiter, again_if_stalled,
                    command_topic, own_folder, service, until, until_in_step, wait_for_launch)
from launch_test import SIMULATED_TOPICS
from serial_communication.msg import McuStatus2, SpeedPWMCommand
from serial_communication.boards.bus import wire as bus
from serial_communication.ros.parameters import PARAMETERS
from serial_communication.srv import Gimbal, Lift, LiftRequest

GRAVITY = 9.81


def orientation(message):
    """w, x, y, z."""
    q = getattr(message, 'orientation', None) or message.transform.rotation
    return q.w, q.x, q.y, q.z


class Car(OnBoard):
    """The IMU of the model car. `Launched` drives it."""

    WORLD, LINK, PARAMETERS = 'car', 'arduino', {'publish_tf': True}

    def turn_to(self, imu, yaw, pitch, roll):
        """Turn the car, one axis after another, while `imu` records the messages."""
        imu.next()
        for name, angle in (('yaw', yaw), ('pitch', pitch), ('roll', roll)):
            self.board.set(name, angle)
            self.until_is('turning', 0)
        # If something stalls, messages of the turn are still on their way.
        wanted = from_euler(yaw, pitch, roll)
        imu.next(lambda m: angle_between(orientation(m), wanted) < 2.0
                 and max(map(abs, self.vector(m.angular_velocity))) < 0.03, what='is at rest')
        still = len(imu.messages) + 5
        until(lambda: len(imu.messages) > still, 'IMU messages of the car at rest')

    def test_a_rotation_of_the_car_is_published_on_imu_and_tf(self):
        imu = self.collect(Topic(self.own('imu'), Imu))
        transforms = transforms_with(self, 'base_link', 'imu_orientation')
        angles = 50, -20, 35
        self.turn_to(imu, *angles)
        message = imu.messages[-1]
        self.assertEqual(message.header.frame_id, 'imu')
        self.assertLess(angle_between(orientation(message), from_euler(*angles)), 2.0)
        for value, wanted in zip(self.vector(message.linear_acceleration),
                                 upward(from_euler(*angles))):
            self.assertAlmostEqual(value, GRAVITY * wanted, delta=0.1)
        for value in self.vector(message.angular_velocity):
            self.assertAlmostEqual(value, 0.0, delta=0.03)
        stamp = message.header.stamp
        until(lambda: transforms.can_transform('base_link', 'imu_orientation', stamp),
              'tf has it')
        found = transforms.lookup_transform('imu', 'imu_orientation', stamp)
        self.assertLess(angle_between(orientation(found), orientation(message)), 0.01)
        found = transforms.lookup_transform('base_link', 'imu_orientation', stamp)
        self.assertLess(angle_between(orientation(found), from_euler(*angles)), 2.0)

    @staticmethod
    def vector(message):
        return message.x, message.y, message.z


class ControlBoard(OnBoard):
    """Lift, gimbal and air."""

    WORLD, LINK = 'ctrl', 'bus'
    # The motion timeout is in s of the world, which pass sooner than the board's on a busy machine.
    PARAMETERS = {'bus/motion_timeout': 60.0, 'bus/functions': {'halt': {
        'cmd2': 0x2F, 'srv_type': 'std_srvs/Trigger', 'repeatable': True, 'interrupts': True}}}
    AXES = 'lift', 'pan', 'tilt'

    def setUp(self):
        super().setUp()
        for end, position in ('bottom', -1e4), ('top', 1e4):    # no repeated move comes there
            self.board.set('lift_' + end, position)
        until_in_step(PACKAGE)
        self.lift = service(self.own('lift'), Lift)
        self.gimbal = service(self.own('gimbal'), Gimbal)

    def state(self):
        """The position, steps and motions of every axis."""
        return {axis: tuple(self.board.get(axis + part)
                            for part in ('_position', '_steps', '_moves')) for axis in self.AXES}

    def settled(self):
        """The same, once nothing has moved for a while."""
        before = self.state()
        self.until_emulated(0.15)
        after = self.state()
        return after if after == before else self.settled()

    def assert_moves(self, call, **by):
        """`call` succeeds and moves each axis by these (units, steps, motions).

        It is called again if the bridge stalled and so did not send it, or dropped the reply.
        """
        def answered():
            until_in_step(PACKAGE)
            before, answer = self.settled(), call()
            return (before, answer) if answer.status not in (NOT_SENT, TIMEOUT) else None
        before, answer = again_if_stalled(answered)
        self.assertTrue(answer.success, answer.message)
        self.assertEqual((answer.status, answer.error_code), (bus.OK, 0))
        done = self.state()
        for axis in self.AXES:
            for was, now, wanted in zip(before[axis], done[axis], by.get(axis, (0, 0, 0))):
                self.assertAlmostEqual(now - was, wanted, 6)
        # The answer was sent at the end of the motion, and nothing moves afterwards.
        self.assertEqual(self.settled(), done)

    def test_even_the_longest_move_ends_within_the_default_timeout(self):
        times = []

        def up():
            began = self.board.time
            answer = self.lift(LiftRequest.UP, 255)
            times.append(self.board.time - began)
            return answer

        def ends_in_time():     # unless this test stalls
            self.assert_moves(up, lift=(255, 25 * 255, 1))
            self.assert_moves(lambda: self.lift(LiftRequest.DOWN, 255), lift=(-255, -25 * 255, 1))
            print(times)
            return times[-1] < PARAMETERS['bus/motion_timeout'].default
        again_if_stalled(ends_in_time)
        self.assert_moves(lambda: self.lift(0, 0))

    def test_concurrent_calls_are_each_executed_once(self):
        def all_at_once():
            # All in different directions: without a pause, two in one would look like one move.
            calls = [Waiter(self.lift, 1, 8), Waiter(self.gimbal, 0, 6), Waiter(self.lift, 0, 5),
                     Waiter(self.gimbal, 3, 5), Waiter(self.gimbal, 1, 7)]
            # A reply that was dropped in a stall is waited for until the motion timeout.
            answers = [call.result(3 * PATIENCE) for call in calls]
            return next((a for a in answers if not a.success), answers[0])
        self.assert_moves(all_at_once, lift=(-3, -75, 2), pan=(-1, -10, 2), tilt=(-5, -50, 1))

    def test_a_stop_ends_a_move_whose_outcome_is_then_unknown(self):
        stop = service(self.own('halt'), Trigger)

        def is_stopped():
            until_in_step(PACKAGE)
            before = self.settled()['lift'][0]
            lift = Waiter(self.lift, 1, 100)
            until(lambda: self.board.get('lift_position') < before - 5 or not lift.is_alive(),
                  'the lift moves')
            answer = stop()
            stopped = self.board.get('lift_position')
            outcome = lift.result(3 * PATIENCE)
            print(before, stopped, answer.message, outcome.message)
            if not answer.success or not before - 99 < stopped < before:
                return False        # a stall: the lift was not sent, or stop() came too late
            self.assertEqual(outcome.status, TIMEOUT)
            self.assertEqual(self.settled()['lift'][0], stopped)
            return True
        again_if_stalled(is_stopped)
        self.assert_moves(lambda: self.lift(0, 2), lift=(2, 50, 1))
        until(lambda: stop().success, 'it is answered if nothing moves')


class SensorBoard(OnBoard):
    """Ranges and orientation."""

    WORLD, LINK, PARAMETERS = 'range', 'mcu', {'publish_tf': True}

    def setUp(self):
        super().setUp()
        self.status = self.collect(Topic('/mcu/status', McuStatus2))
        self.status.first(lambda m: m.connected)

    def restore(self, **values):
        """Restore the world at the end of the test."""
        for name, value in values.items():
            self.addCleanup(self.board.set, name, value)

    def test_heading_pitch_and_roll_are_published_as_they_are_in_the_world(self):
        imu = self.collect(Topic('/mcu/imu', Imu))
        transforms = transforms_with(self, 'mcu_imu', 'mcu_imu_orientation')
        self.restore(heading=0, pitch=0, roll=0)
        # 350 degrees is wrapped in the frame's int16, and ROS counts yaw counter-clockwise.
        for heading, pitch, roll in ((350, 0, 0), (179.5, 30, -40)):
            with self.about(heading=heading, pitch=pitch, roll=roll):
                for name, value in (('heading', heading), ('pitch', pitch), ('roll', roll)):
                    self.board.set(name, value)
                wanted = from_euler(-heading, pitch, roll)
                status = self.status.next(lambda m, h=heading, p=pitch, r=roll: max(
                    abs(m.yaw - h), abs(m.pitch - p), abs(m.roll - r)) < 0.011)
                self.assertTrue(status.valid)
                imu.next(lambda m, w=wanted: angle_between(orientation(m), w) < 0.1)
                message = imu.next()
                self.assertLess(angle_between(orientation(message), wanted), 0.1)
                stamp = message.header.stamp
                until(lambda s=stamp: transforms.can_transform('mcu_imu', 'mcu_imu_orientation',
                                                               s), 'tf has it')
                found = transforms.lookup_transform('mcu_imu', 'mcu_imu_orientation', stamp)
                self.assertLess(angle_between(orientation(found), wanted), 0.1)


class Hello(OnBoard):
    """The library's first example, which announces its rows: the bridge has no parameter for it."""

    WORLD, LINK, IMAGE = 'car', 'arduino', 'Hello.elf'

    def test_its_value_is_published_and_its_lamp_follows_the_command(self):
        light = self.collect(Topic(self.own('light'), UInt16, wait=False))
        until_announced(self.board, light)
        for raw in 700, 12:
            self.board.set('steering_feedback', raw)     # what is at A0 here
            light.first(lambda message, raw=raw: message.data == raw)
        lamp = command_topic(self.own('lamp'), Bool)
        self.addCleanup(lamp.unregister)
        for on in True, False:
            self.until_is('led_builtin', on, doing=lambda on=on: lamp.publish(on))


class Launched(unittest.TestCase):
    """bridge.launch sim:=avr: all three boards, and a bridge that is started again."""

    NAMESPACE = '/launched'
    NODE = NAMESPACE + '/' + PACKAGE

    def setUp(self):
        self.folder = own_folder()
        self.addCleanup(shutil.rmtree, self.folder, ignore_errors=True)
        self.output = Output()
        self.addCleanup(self.output.close)
        self.process = subprocess.Popen(
            ['roslaunch', PACKAGE, 'bridge.launch', 'sim:=avr', 'sim_dir:=' + self.folder],
            env=dict(os.environ, ROS_NAMESPACE=self.NAMESPACE), stdout=self.output,
            stderr=subprocess.STDOUT)
        self.addCleanup(self.end)

    def end(self):
        """Send Ctrl-C; return the output and the exit status."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        status = self.process.wait(PATIENCE)
        return self.output.text(), status

    def ask(self, link, line):
        """Send a line to the control channel of a link's board; return the answer."""
        with socket.socket(socket.AF_UNIX) as control:
            control.settimeout(PATIENCE)
            control.connect(os.path.join(self.folder, link + '.control'))
            control.sendall(line.encode() + b'\n')
            return control.makefile().readline().strip()

    def get(self, link, name):
        return float(self.ask(link, 'get ' + name))

    def assert_moves(self, position, units, call, *arguments):
        """A call succeeds and moves an axis; it is repeated as in `ControlBoard.assert_moves`."""
        def moved():
            until_in_step(self.NODE[1:])
            before, answer = self.get('bus', position), call(*arguments)
            if answer.status in (NOT_SENT, TIMEOUT):
                return False
            self.assertTrue(answer.success, answer.message)
            self.assertAlmostEqual(self.get('bus', position) - before, units, 6)
            return True
        again_if_stalled(moved)

    def bridge_pid(self):
        """The process id of the bridge; 0 if it does not answer."""
        try:
            uri = rosgraph.Master('/avr_test').lookupNode(self.NODE)
            return ServerProxy(uri).getPid('/avr_test')[2]
        except (OSError, rosgraph.MasterException):
            return 0

    def test_all_boards_work_and_a_bridge_that_is_killed_returns_with_the_motor_off(self):
        wait_for_launch(self.NODE[1:])
        for name, message_class in SIMULATED_TOPICS:
            topic = Topic(self.NAMESPACE + name, message_class)
            self.addCleanup(topic.close)
            topic.first()
        self.assert_moves('lift_position', 4, service(self.NODE + '/lift', Lift), 0, 4)
        self.assert_moves('pan_position', -3, service(self.NODE + '/gimbal', Gimbal), 1, 3)

        def drive():
            speed = command_topic(self.NODE + '/speed', SpeedPWMCommand)
            until(lambda: self.get('arduino', 'motor_pwm') == 128, 'the motor runs',
                  doing=lambda: speed.publish(value=500))
            speed.unregister()
        drive()
        pid = until(self.bridge_pid, 'the bridge answers')
        os.kill(pid, signal.SIGKILL)
        until(lambda: self.get('arduino', 'motor_pwm') == 0, 'the motor stops')
        changes = self.ask('arduino', 'history motor_pwm')
        until(lambda: self.bridge_pid() not in (0, pid), 'roslaunch starts the bridge again',
              every=0.1)
        received = self.get('arduino', 'rx_bytes')
        until(lambda: self.get('arduino', 'rx_bytes') > received + 200, 'heartbeats come again')
        self.assertEqual(self.ask('arduino', 'history motor_pwm'), changes)
        drive()
        text, status = self.end()
        self.assertEqual(status, 0, text)
        self.assertNotIn('escalating', text)
        self.assertNotIn('Traceback', text)
        self.assertEqual([name for name in os.listdir(self.folder) if not name.endswith('.eeprom')],
                         [], 'what the boards leave behind')


if __name__ == '__main__':
    rospy.init_node('avr_test')
    rostest.rosrun(PACKAGE, 'avr', '__main__')
