#!/usr/bin/python3
"""Commands that may be old are refused: latched long ago, received on an old connection, old by
their stamps, or left waiting while the bridge was suspended."""
import os
import shutil
import signal
import subprocess
import threading
import unittest

import rospy
import rostest
from sensor_msgs.msg import Temperature
from std_msgs.msg import String, UInt8

from boards import PACKAGE, PATIENCE, SPEED_0_PACKET, Bridge, CarBoard, Line, own_folder, until
from publishers import FakePublisher
from serial_communication.link.sparing_log import SparingLog
from serial_communication.msg import SpeedPWMCommand, SteeringPWMCommand
from serial_communication.boards.arduino import wire as arduino
from serial_communication.ros import commands

NODE = '/' + PACKAGE
OWN = {'heater': {'type': 60, 'direction': 'to_board', 'ros_type': 'sensor_msgs/Temperature',
                  'layout': '<h', 'fields': ['temperature']},
       'horn': {'type': 61, 'direction': 'to_board', 'ros_type': 'std_msgs/UInt8',
                'layout': '<B', 'fields': ['data']}}
HOUR = 3600.0


def speed(value, ago=None):
    """A command whose stamp is that many seconds old; None: no stamp."""
    message = SpeedPWMCommand(value=value)
    if ago is not None:
        message.header.stamp = rospy.Time.now() - rospy.Duration(ago)
    return message


class CommandsTest(unittest.TestCase):
    """A car, and a bridge that each test starts."""

    def setUp(self):
        self.folder = own_folder()
        self.addCleanup(shutil.rmtree, self.folder)
        self.line = Line(os.path.join(self.folder, 'arduino')).plug()
        self.addCleanup(self.line.unplug)
        self.car = CarBoard(self.line.far)
        self.addCleanup(self.car.close)
        self.bridge = None

    def start_bridge(self, **parameters):
        """Start the bridge, and wait until its topics are registered."""
        self.bridge = Bridge(parameters={'arduino/port': self.line.near, 'arduino/messages': OWN,
                                         **{'arduino/' + key: value
                                            for key, value in parameters.items()}})
        self.addCleanup(self.bridge.end)
        rospy.wait_for_service(NODE + '/calibrate_imu', 15)
        until(lambda: self.car.heartbeats(), 'a heartbeat')

    def publisher(self, name='/driver', topic='speed', message_class=SpeedPWMCommand, **more):
        """A FakePublisher, which ends with the test."""
        made = FakePublisher(name, NODE + '/' + topic, message_class, **more)
        self.addCleanup(made.close)
        return made

    def assert_drives(self, publisher, value, ago=None, seconds=PATIENCE):
        """A speed, published again and again, reaches the board."""
        until(lambda: value in self.car.speeds, 'speed %d' % value, seconds,
              doing=lambda: publisher.say(speed(value, ago)), every=0.1)

    def assert_said(self, *words):
        """One line of the bridge's output has all of these."""
        line = self.bridge.wait_for(words[0])
        for each in words:
            self.assertIn(each, line)


class Latched(CommandsTest):
    """Latched commands; `rostopic pub` latches by default."""

    def rostopic(self, value, *options):
        """Start a `rostopic pub` of one speed."""
        process = subprocess.Popen(['rostopic', 'pub', *options, NODE + '/speed',
                                    PACKAGE + '/SpeedPWMCommand', '{value: %d}' % value],
                                   stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

        def end():
            process.send_signal(signal.SIGINT)
            process.wait(15)
        self.addCleanup(end)
        return process

    def test_a_speed_that_rostopic_latched_before_the_start_of_the_bridge_is_refused(self):
        self.rostopic(500)
        master = rospy.get_master()
        until(lambda: any(name == NODE + '/speed' for name, _ in master.getSystemState()[2][0]),
              'rostopic publishes')
        self.start_bridge()
        self.assert_said('speed 500 refused', '/rostopic_', 'latches %s/speed' % NODE,
                         'is older than the subscription', 'pub -1')
        # Commands published now are accepted, each time.
        for value in (101, 102):
            self.rostopic(value, '-1')
            until(lambda v=value: v in self.car.speeds, 'speed %d' % value)
        self.assertNotIn(500, self.car.speeds)

    def test_every_kind_of_command_latched_before_the_start_is_refused(self):
        made = [self.publisher('/steerer', 'steering', SteeringPWMCommand, latching=True,
                               latched=SteeringPWMCommand(value=1600)),
                self.publisher('/lights', 'led', String, latching=True, latched=String('left')),
                self.publisher('/heating', 'heater', Temperature, latching=True,
                               latched=Temperature(temperature=30)),
                self.publisher('/horns', 'horn', UInt8, latching=True, latched=UInt8(7))]
        self.start_bridge()
        for words in 'steering 1600', "LED 'left'", 'heater temperature=30', 'horn data=7':
            self.assert_said(words + ' refused: /', 'latches')
        self.assertEqual(self.car.raw_commands, [])
        # The second message on each connection is new.
        made[0].say(SteeringPWMCommand(value=1700))
        made[1].say(String('right'))
        made[2].say(Temperature(temperature=31))
        made[3].say(UInt8(8))
        until(lambda: all(packet in bytes(self.car.wire) for packet in (
            arduino.encode(arduino.SteeringCommand(1700)),
            arduino.encode(arduino.LedCommand('right')),
            arduino.encode_raw(60, bytes((31, 0))), arduino.encode_raw(61, bytes((8,))))),
            'the new ones')

    def test_a_latched_message_is_accepted_once_however_often_its_publisher_connects(self):
        self.start_bridge()
        driver = self.publisher(latching=True, latched=speed(500)).connected()
        until(lambda: 500 in self.car.speeds, 'it has just been published')
        until(lambda: self.car.speeds[-1] == 0, 'the speed timeout')
        for _ in range(2):
            self.car.forget()
            driver.reconnect()
            self.assert_drives(driver, 501)
            self.assertNotIn(500, self.car.speeds)
        self.assert_said('speed 500 refused', '/driver', 'connected again')

    def test_an_older_publisher_that_never_sent_is_refused_when_it_reconnects(self):
        driver = self.publisher(latching=True)
        self.start_bridge()
        driver.connected()
        driver._latched = speed(500)
        driver.reconnect()
        self.assert_said('speed 500 refused', 'is older than the subscription')
        self.assert_drives(driver, 501)
        self.assertNotIn(500, self.car.speeds)

    def test_a_latched_stop_is_accepted(self):
        """It may have been published while the network was cut."""
        self.start_bridge(speed_timeout=0.0)
        driver = self.publisher(latching=True).connected()
        self.assert_drives(driver, 300)
        driver._latched = speed(0)
        driver.reconnect()
        until(lambda: self.car.speeds[-1] == 0, 'it stops')

    def test_a_publisher_that_does_not_latch_may_reconnect(self):
        driver = self.publisher()
        self.start_bridge()
        driver.connected().say(speed(300))
        until(lambda: 300 in self.car.speeds, 'the first message')
        driver.reconnect()
        driver.say(speed(301))
        until(lambda: 301 in self.car.speeds, 'the first one of another connection')


class WithoutMaster(unittest.TestCase):
    """The master does not answer when the bridge subscribes."""

    def test_every_publisher_counts_as_older_than_the_subscription(self):
        class Silent:
            """A master that does not answer."""

            def __init__(self, _name):
                raise OSError('no route')

        said, taken = [], []
        log = SparingLog('arduino', rospy)
        log.warn = lambda cause, text: said.append(text)
        real, commands.rosgraph.Master = commands.rosgraph.Master, Silent
        try:
            commands.CommandTopic('/horn', UInt8, lambda message: taken.append(message.data),
                                  lambda message: 'horn %d' % message.data, log, 0.5)
        finally:
            commands.rosgraph.Master = real
        publisher = FakePublisher('/late', '/horn', UInt8, latching=True, latched=UInt8(1))
        self.addCleanup(publisher.close)
        until(lambda: said, 'a warning')
        self.assertIn('horn 1 refused: /late latches /horn', said[0])
        publisher.say(UInt8(2))
        until(lambda: taken == [2], 'the second one')


class Connections(CommandsTest):
    """Two connections of one publisher's name: the older one's process is dead."""

    def test_only_the_newest_connection_of_a_name_is_used(self):
        self.start_bridge()
        old = self.publisher().connected()
        self.assert_drives(old, 300)
        new = self.publisher().connected()
        self.assert_drives(new, 400)
        for _ in range(30):
            old.say(speed(301))
            new.say(speed(401))
            threading.Event().wait(0.01)
        self.assert_said('speed 301 refused', 'an old connection of /driver')
        until(lambda: 401 in self.car.speeds, 'the newest one')
        self.assertNotIn(301, self.car.speeds)

    def test_an_old_connection_is_still_refused_when_the_newer_one_has_closed(self):
        self.start_bridge()
        old = self.publisher().connected()
        self.assert_drives(old, 300)
        new = self.publisher().connected()
        self.assert_drives(new, 400)
        new.connections[-1].close()
        for _ in range(30):
            old.say(speed(301))
            threading.Event().wait(0.02)
        self.assert_said('speed 301 refused', 'an old connection of /driver')
        self.assertNotIn(301, self.car.speeds)

    def test_publishers_of_other_names_do_not_disturb_each_other(self):
        self.start_bridge()
        one, other = self.publisher('/one').connected(), self.publisher('/other').connected()
        for publisher, value in ((one, 1), (other, 2), (one, 3), (other, 4)):
            self.assert_drives(publisher, value)


class Stamps(CommandsTest):
    """The age of a command by its stamp."""

    def setUp(self):
        super().setUp()
        self.start_bridge()
        self.driver = self.publisher().connected()

    def test_stamps_that_are_always_3_s_old_are_always_refused(self):
        for value in range(1, 61):
            self.driver.say(speed(value, ago=3.0))
            threading.Event().wait(0.02)
        self.assert_said('speed 1 refused: its stamp is ', ' s old', 'allows 0.5 s', '/driver',
                         'chrony')
        self.assert_drives(self.driver, 300, ago=0.0)
        self.assertEqual(set(self.car.speeds) - {0}, {300})     # published again and again

    def test_a_late_command_is_refused_after_punctual_ones(self):
        self.assert_drives(self.driver, 100, ago=0.0)
        self.driver.say(speed(700, ago=1.4))
        self.assert_said('speed 700 refused: its stamp is ')
        self.assertNotIn(700, self.car.speeds)

    def test_a_stamp_2_h_in_the_future_does_not_affect_later_commands(self):
        self.assert_drives(self.driver, 100, ago=0.0)
        self.driver.say(speed(700, ago=-2 * HOUR))
        self.assert_said('speed 700 refused: its stamp is ', ' s in the future')
        self.assert_drives(self.driver, 200, ago=0.0, seconds=4.0)
        self.driver.say(speed(0, ago=0.0))
        until(lambda: self.car.speeds[-1] == 0, 'the stop')
        self.assertNotIn(700, self.car.speeds)

    def test_speed_0_is_accepted_whatever_its_stamp_is(self):
        self.bridge.end()
        self.start_bridge(speed_timeout=0.0)
        self.driver.connected(2)
        for ago in (-2 * HOUR, 3.0, 5 * HOUR):
            self.car.forget()
            self.assert_drives(self.driver, 300, ago=0.0)
            self.driver.say(speed(0, ago=ago))
            until(lambda: self.car.raw_commands[-1] == SPEED_0_PACKET, 'it stops')

    def test_steering_and_custom_commands_with_a_header_follow_the_same_rules(self):
        def stamped(message, ago):
            message.header.stamp = rospy.Time.now() - rospy.Duration(ago)
            return message

        steerer = self.publisher('/steerer', 'steering', SteeringPWMCommand).connected()
        heating = self.publisher('/heating', 'heater', Temperature).connected()
        for _ in range(30):
            steerer.say(stamped(SteeringPWMCommand(value=1600), 3.0))
            heating.say(stamped(Temperature(temperature=30), 5.0))
            threading.Event().wait(0.01)
        self.assert_said('steering 1600 refused: its stamp is ', '/steerer')
        self.assert_said('heater temperature=30 refused: its stamp is ', '/heating')

        def say():
            steerer.say(stamped(SteeringPWMCommand(value=1700), 0.0))
            heating.say(stamped(Temperature(temperature=31), 0.0))

        until(lambda: arduino.encode(arduino.SteeringCommand(1700)) in bytes(self.car.wire)
              and arduino.encode_raw(60, bytes((31, 0))) in bytes(self.car.wire),
              'those in time', doing=say, every=0.1)
        self.assertNotIn(arduino.encode(arduino.SteeringCommand(1600)), bytes(self.car.wire))
        self.assertNotIn(arduino.encode_raw(60, bytes((30, 0))), bytes(self.car.wire))


class Parameters(CommandsTest):
    """command_age and speed_timeout."""

    def test_a_command_age_of_0_accepts_any_stamp(self):
        self.start_bridge(command_age=0.0)
        driver = self.publisher().connected()
        self.assert_drives(driver, 300, ago=HOUR)
        self.assert_drives(driver, 301, ago=-HOUR)

    def test_without_a_speed_timeout_a_suspended_bridge_drops_the_commands_that_waited(self):
        self.start_bridge(speed_timeout=0.0)
        driver = self.publisher().connected()
        self.assert_drives(driver, 619)
        process = self.bridge.process
        process.send_signal(signal.SIGSTOP)
        os.waitpid(process.pid, os.WUNTRACED)
        for _ in range(20):
            driver.say(speed(321))
            threading.Event().wait(0.1)
        self.car.forget()
        process.send_signal(signal.SIGCONT)
        self.assert_said(' s: SPEED 0 is sent first')
        until(lambda: self.car.heartbeats() > 10, 'heartbeats')
        # The signal may have arrived between the decision to send a heartbeat and its write.
        self.assertIn(SPEED_0_PACKET, self.car.raws[:2])
        self.assert_drives(driver, 400, ago=0.0)
        # Both are published again and again.
        self.assertEqual((self.car.speeds[0], set(self.car.speeds)), (0, {0, 400}))


if __name__ == '__main__':
    rospy.init_node('commands_test')
    rostest.rosrun(PACKAGE, 'commands', '__main__')
