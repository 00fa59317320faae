#!/usr/bin/python3
"""Several robots under one master: each bridge reads and moves only its own boards."""
import os
import re
import shutil
import signal
import subprocess
import unittest

import roslaunch
import rospy
import rostest
from sensor_msgs.msg import Imu, Range
from tf2_msgs.msg import TFMessage

from boards import (NOT_SENT, Output, PACKAGE, PATIENCE, TIMEOUT, BusBoard, CarBoard, Diagnostics,
                    Line, SensorBoard, Topic, again_if_stalled, command_topic, level_imu,
                    own_folder, ranges, service, settle, until, until_in_step,
                    wait_for_launch)
from serial_communication.msg import (Environment, McuStatus2, SerialMsg, SpeedPWMCommand, Ticks,
                                      Voltage)
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.srv import GetEnvironment, Lift

LINKS = 'bus', 'arduino', 'mcu'
NUMBERS = 1, 2, 3

_ROBOT = """
  <group ns="robot_{number}">
    <include file="$(find serial_communication)/launch/bridge.launch">
      <arg name="name" value="{name}"/>
      <arg name="frame_prefix" value="robot_{number}/"/>
      <arg name="publish_tf" value="true"/>
      {ports}
    </include>
  </group>"""


def launch_file(folder, ports):
    """Write a launch file that includes bridge.launch for each robot, with arguments by `ports`."""
    path = os.path.join(folder, 'fleet.launch')
    with open(path, 'w', encoding='utf-8') as file:
        file.write('<launch>%s\n</launch>\n' % ''.join(_ROBOT.format(
            number=number, name=NAMES[number], ports='\n      '.join(
                f'<arg name="{name}" value="{value}"/>' for name, value in ports(number)))
            for number in NUMBERS))
    return path


# The first two have the same name in different namespaces; the third has another name.
NAMES = {1: PACKAGE, 2: PACKAGE, 3: 'bridge'}


def answered(node, call):
    """Call a bus service; again if the bridge stalled and sent nothing, or dropped the reply."""
    def answer():
        until_in_step(node)
        response = call()
        return None if response.status in (NOT_SENT, TIMEOUT) else response
    return again_if_stalled(answer)


class Robot:
    """A robot: three boards whose values all show which robot it is."""

    def __init__(self, folder, number):
        self.number = number
        self.node = f'robot_{number}/{NAMES[number]}'
        self.lines = {link: Line(os.path.join(folder, f'{link}{number}')).plug()
                      for link in LINKS}
        self.bus = BusBoard(self.lines['bus'].far, polled=True)
        self.bus.air = bus.Environment(100 + number, 20.0 + number, 30.0 + number)
        self.car = CarBoard(self.lines['arduino'].far)
        self.sensors = SensorBoard(self.lines['mcu'].far)

    def say(self):
        """Send measurements from its car and its sensors."""
        self.car.say(arduino.Voltage(10.0 + self.number))
        self.car.say(arduino.Ticks(self.number))
        self.car.say(level_imu())
        self.sensors.say(ranges(first=100 * self.number, second=100 * self.number + 50))

    def close(self):
        """Close its boards and lines."""
        for board in self.bus, self.car, self.sensors:
            board.close()
        for line in self.lines.values():
            line.unplug()


class Fleet(unittest.TestCase):
    """Three bridges, nine boards."""

    @classmethod
    def setUpClass(cls):
        cls.folder = own_folder()
        cls.robots = [Robot(cls.folder, number) for number in NUMBERS]
        path = launch_file(cls.folder, lambda number: [
            (link + '_port', cls.robots[number - 1].lines[link].near) for link in LINKS])
        cls.output = Output()
        cls.process = subprocess.Popen(['roslaunch', path], stdout=cls.output,
                                       stderr=subprocess.STDOUT)
        for robot in cls.robots:
            wait_for_launch(robot.node)
            settle(robot.node, robot.bus)
            until(lambda r=robot: r.car.connected and r.sensors.connected, 'its boards are there')

    @classmethod
    def tearDownClass(cls):
        cls.process.send_signal(signal.SIGINT)
        cls.process.wait(PATIENCE)
        for robot in cls.robots:
            robot.close()
        shutil.rmtree(cls.folder)

    def topics(self, name, message_class, private=True):
        """The topic of each robot."""
        return [Topic('/%s/%s' % (robot.node if private else 'robot_%d' % robot.number, name),
                      message_class) for robot in self.robots]

    def test_each_robot_publishes_only_its_own_values(self):
        expected = (
            (self.topics('voltage', Voltage), lambda m, n: m.value == 10.0 + n),
            (self.topics('ticks', Ticks), lambda m, n: m.value == n),
            (self.topics('imu', Imu), lambda m, n: m.header.frame_id == f'robot_{n}/imu'),
            (self.topics('environment', Environment), lambda m, n: m.smoke == 100 + n),
            (self.topics('mcu/status', McuStatus2, private=False),
             lambda m, n: m.vl53_1 == 100 * n or not m.connected),
            (self.topics('mcu/range_2', Range, private=False),
             lambda m, n: (m.header.frame_id == f'robot_{n}/range_2'
                           and abs(m.range - (0.1 * n + 0.05)) < 1e-6)),
        )
        frames = self.topics('serial_msg', SerialMsg, private=False)
        for _ in range(20):
            until(lambda: all(topic.messages for topic in expected[0][0]), 'something comes',
                  every=0.1, doing=lambda: [robot.say() for robot in self.robots])
        for topics, right in expected:
            for robot, topic in zip(self.robots, topics):
                topic.first(doing=robot.say)
                wrong = [m for m in topic.messages if not right(m, robot.number)]
                self.assertEqual(wrong[:1], [], topic.name)
        for robot, topic in zip(self.robots, frames):
            topic.first(lambda m: m.link == 'bus' and m.direction == 0 and m.data)
            topic.first(lambda m: m.link == 'arduino' and m.type == arduino.Voltage.TYPE)
            read = {bytes(m.frame) for m in topic.messages if m.link == 'arduino'
                    and m.type == arduino.Voltage.TYPE}
            self.assertEqual(read, {arduino.encode(arduino.Voltage(10.0 + robot.number))})

    def test_calls_and_commands_reach_only_the_robot_that_they_are_for(self):
        for robot in self.robots:
            robot.bus.forget()
            robot.car.forget()
        for robot in self.robots:
            self.command(robot)
        for robot in self.robots:
            moves = {frame.message.data[-1] for frame in robot.bus.frames
                     if frame.message.cmd1 == bus.FUNCTION and frame.message.cmd2 == bus.LIFT}
            self.assertEqual(moves, {robot.number})
            self.assertEqual(set(robot.car.speeds) - {0}, {robot.number})

    def command(self, robot):
        lift = service(f'/{robot.node}/lift', Lift)
        self.assertTrue(answered(robot.node, lambda: lift(0, robot.number)).success)
        environment = answered(robot.node,
                               service(f'/{robot.node}/get_environment', GetEnvironment))
        self.assertEqual(environment.environment.smoke, 100 + robot.number)
        speed = command_topic(f'/{robot.node}/speed', SpeedPWMCommand)
        until(lambda: robot.number in robot.car.speeds, 'the car drives',
              doing=lambda: speed.publish(value=robot.number), every=0.05)

    def test_diagnostics_and_frame_ids_name_their_robot(self):
        for robot in self.robots:
            found = Diagnostics(robot.node).wait_for_all(LINKS, lambda s, _link: True, 'any level')
            self.assertEqual({link: status.hardware_id for link, status in found.items()},
                             {link: line.near for link, line in robot.lines.items()})
        topic = Topic('/tf_static', TFMessage)
        for robot in self.robots:
            def frames(node='/' + robot.node):
                return {(t.header.frame_id, t.child_frame_id) for m in list(topic.messages)
                        if m._connection_header['callerid'] == node for t in m.transforms}
            until(frames, 'mounts of ' + robot.node)
            prefix = f'robot_{robot.number}/'
            self.assertEqual(frames(), {(prefix + 'base_link', prefix + child) for child in (
                'imu', 'mcu_imu', 'range_1', 'range_2')})

    def test_lines_of_the_log_name_their_robot(self):
        def named():
            return set(re.findall(r'\[INFO\] \[[\d.]+\] (\S+): ', self.output.text()))
        until(lambda: {f'/{robot.node}' for robot in self.robots} <= named(), 'each has a line')

    def test_simulated_boards_of_several_robots_have_different_ports_and_names(self):
        config = roslaunch.config.load_config_default(
            [launch_file(self.folder, lambda number: [('sim', 'true')])], None)
        ports = [each.value for name, each in config.params.items() if name.endswith('/port')]
        self.assertEqual((len(ports), len(set(ports))), (9, 9), ports)
        nodes = [each.namespace + each.name for each in config.nodes]
        self.assertEqual((len(nodes), len(set(nodes))), (12, 12), nodes)


if __name__ == '__main__':
    rospy.init_node('fleet_test')
    rostest.rosrun(PACKAGE, 'fleet', '__main__')
