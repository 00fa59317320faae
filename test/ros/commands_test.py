#!/usr/bin/python3
"""Commands that may be old are refused, of every kind: latched long ago, received on an old
connection, or old by their stamps."""
import re
import threading

import rospy
import rostest
from sensor_msgs.msg import Temperature
from std_msgs.msg import String, UInt8

from boards import PACKAGE, PATIENCE, BoardsTest, CarBoard, until
from publishers import FakePublisher
from serial_communication.msg import SpeedPWMCommand, SteeringPWMCommand
from serial_communication.boards.arduino import wire as arduino

NODE = '/' + PACKAGE
OWN = {'heater': {'type': 60, 'direction': 'to_board', 'ros_type': 'sensor_msgs/Temperature',
                  'layout': '<h', 'fields': ['temperature']},
       'horn': {'type': 61, 'direction': 'to_board', 'ros_type': 'std_msgs/UInt8',
                'layout': '<B', 'fields': ['data']}}
HOUR = 3600.0
# The topic, an old command and its words in the log, a new command and its packet.
KINDS = (
    ('speed', SpeedPWMCommand(value=500), 'speed 500', SpeedPWMCommand(value=501),
     arduino.encode(arduino.SpeedCommand(501))),
    ('steering', SteeringPWMCommand(value=1600), 'steering 1600', SteeringPWMCommand(value=1700),
     arduino.encode(arduino.SteeringCommand(1700))),
    ('led', String('left'), "LED 'left'", String('right'),
     arduino.encode(arduino.LedCommand('right'))),
    ('heater', Temperature(temperature=30), 'heater temperature=30', Temperature(temperature=31),
     arduino.encode_raw(60, bytes((31, 0)))),
    ('horn', UInt8(7), 'horn data=7', UInt8(8), arduino.encode_raw(61, bytes((8,)))),
)


def stamped(message, ago):
    """A message with a stamp that is that many seconds old."""
    message.header.stamp = rospy.Time.now() - rospy.Duration(ago)
    return message


class CommandsTest(BoardsTest):
    """A car, and a bridge that each test starts."""

    def setUp(self):
        super().setUp()
        self.car = self.plug('arduino', CarBoard)

    def start_bridge(self, **parameters):
        """Start the bridge, and wait until its topics are registered."""
        self.bridge = super().start_bridge(parameters={
            'arduino/port': self.lines['arduino'].near, 'arduino/messages': OWN,
            **{'arduino/' + key: value for key, value in parameters.items()}})
        rospy.wait_for_service(NODE + '/calibrate_imu', PATIENCE)
        until(self.car.heartbeats, 'a heartbeat')

    def publisher(self, topic='speed', message_class=SpeedPWMCommand, **more):
        """A FakePublisher, named after its topic, which ends with the test."""
        made = FakePublisher('/of_' + topic, f'{NODE}/{topic}', message_class, **more)
        self.addCleanup(made.close)
        return made

    def until_on_the_wire(self, packets, doing=None):
        until(lambda: all(packet in bytes(self.car.wire) for packet in packets), 'the new ones',
              doing=doing, every=0.1)

    def assert_drives(self, publisher, value, ago=0.0):
        """A speed, published again and again, reaches the board."""
        until(lambda: value in self.car.speeds, f'speed {value}', every=0.1, doing=lambda:
              publisher.say(stamped(SpeedPWMCommand(value=value), ago)))

    def assert_said(self, *words):
        """One line of the bridge's output has all of these."""
        line = self.bridge.wait_for(words[0])
        for each in words:
            self.assertIn(each, line)

    def test_every_kind_of_command_latched_before_the_start_is_refused(self):
        made = [self.publisher(topic, type(old), latching=True, latched=old)
                for topic, old, *_ in KINDS]
        self.start_bridge()
        for topic, _old, words, *_ in KINDS:
            self.assert_said(f'{words} refused: /of_{topic} latches {NODE}/{topic}',
                             'is older than the subscription', 'pub -1')
        self.assertEqual(self.car.raw_commands, [])

        def say():
            for publisher, (*_, new, _packet) in zip(made, KINDS):
                publisher.say(new)

        def say_again():        # only if a stall of this machine kept one back
            if re.search('the bridge stalled|the port takes no data', self.bridge.output()):
                say()
        say()       # the second message on each connection is new
        self.until_on_the_wire([packet for *_, packet in KINDS], say_again)

    def test_an_old_connection_is_still_refused_when_the_newer_one_has_closed(self):
        self.start_bridge()
        old = self.publisher().connected()
        self.assert_drives(old, 300)
        new = self.publisher().connected()
        self.assert_drives(new, 400)
        new.connections[-1].close()
        for _ in range(30):
            old.say(SpeedPWMCommand(value=301))
            threading.Event().wait(0.02)
        # A line about an earlier command, which a stall delayed, keeps this one back for 10 s.
        until(lambda: 'speed 301 refused' in self.bridge.output(), 'it is refused', every=0.1,
              doing=lambda: old.say(SpeedPWMCommand(value=301)))
        self.assert_said('speed 301 refused', 'an old connection of /of_speed')
        self.assertNotIn(301, self.car.speeds)

    def test_a_command_age_of_0_accepts_any_stamp(self):
        self.start_bridge(command_age=0.0)
        driver = self.publisher().connected()
        self.assert_drives(driver, 300, ago=HOUR)
        self.assert_drives(driver, 301, ago=-HOUR)


if __name__ == '__main__':
    rospy.init_node('commands_test')
    rostest.rosrun(PACKAGE, 'commands', '__main__')
