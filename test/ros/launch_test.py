#!/usr/bin/python3
"""bridge.launch: with ports on the command line, and with simulated boards."""
import os
import shutil
import signal
import subprocess
import tempfile
import unittest

import rosgraph
import rospy
import rostest
import yaml
from sensor_msgs.msg import Imu, Range, RelativeHumidity, Temperature
from std_msgs.msg import Bool
from std_srvs.srv import Empty, Trigger

from boards import (OK, PACKAGE, PATIENCE, BusBoard, CarBoard, Diagnostics, Line, Topic,
                    command_topic, own_folder, service, until)
from serial_communication.msg import (Environment, McuStatus2, SerialMsg, SpeedPWMCommand,
                                      SteeringFeedback, Ticks, Voltage)
from serial_communication.boards.arduino import wire as arduino
from serial_communication.srv import GetEnvironment, Gimbal, Lift

SIMULATED_TOPICS = (
    ('/serial_msg', SerialMsg), ('/serial_communication/imu', Imu),
    ('/serial_communication/imu/temperature', Temperature),
    ('/serial_communication/imu/calibrating', Bool),
    ('/serial_communication/voltage', Voltage), ('/serial_communication/ticks', Ticks),
    ('/serial_communication/steering_angle', SteeringFeedback),
    ('/serial_communication/environment', Environment),
    ('/serial_communication/environment/temperature', Temperature),
    ('/serial_communication/environment/humidity', RelativeHumidity),
    ('/mcu/status', McuStatus2), ('/mcu/imu', Imu), ('/mcu/range_1', Range),
    ('/mcu/range_2', Range))


class Launch(unittest.TestCase):
    """roslaunch, started and ended as a user does."""

    def setUp(self):
        self.folder = own_folder()
        self.lines, self.boards, self.process = [], [], None

    def tearDown(self):
        if self.process and self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            self.process.wait(PATIENCE)
        for part in self.boards:
            part.close()
        for line in self.lines:
            line.unplug()
        shutil.rmtree(self.folder, ignore_errors=True)

    def launch(self, *arguments):
        """Run roslaunch serial_communication bridge.launch with these arguments."""
        self.output = tempfile.TemporaryFile('w+')
        self.process = subprocess.Popen(['roslaunch', PACKAGE, 'bridge.launch'] + list(arguments),
                                        stdout=self.output, stderr=subprocess.STDOUT)

    def end(self):
        """Send Ctrl-C; the bridge then logs no warning, even if its boards end first."""
        before = len(self.output_so_far())
        self.process.send_signal(signal.SIGINT)
        status = self.process.wait(PATIENCE)
        self.output.seek(0)
        text = self.output.read()
        self.assertEqual(status, 0, text)
        self.assertNotIn('Traceback', text)
        self.assertNotIn('escalating', text)
        self.assertNotIn('[WARN]', text[before:])
        self.assertNotIn('[ERROR]', text[before:])

    def output_so_far(self):
        """The output of roslaunch and the bridge."""
        self.output.seek(0)
        return self.output.read()

    def open_two_lines(self):
        """Plug in a bus board and a car."""
        self.lines = [Line(os.path.join(self.folder, name)).plug() for name in ('bus', 'arduino')]
        self.boards = [BusBoard(self.lines[0].far), CarBoard(self.lines[1].far)]

    def launch_with_two_ports(self, *arguments):
        """Launch with a bus board and a car; both work when this returns the car."""
        self.open_two_lines()
        self.launch('bus_port:=' + self.lines[0].near, 'arduino_port:=' + self.lines[1].near,
                    *arguments)
        return self.assert_two_links_work()

    def assert_two_links_work(self):
        """Wait until both boards work; return the car."""
        bus_board, car = self.boards
        until(lambda: service('/serial_communication/lift', Lift)(0, 100).success,
              'the lift answers')
        self.assertIn(bytes.fromhex('a50255200064b6'), bus_board.raws)
        Topic('/serial_communication/voltage', Voltage).first(
            doing=lambda: car.say(arduino.Voltage(12.0)))
        return car

    def test_ports_on_the_command_line_are_used_and_ctrl_c_ends_with_speed_0(self):
        car = self.launch_with_two_ports()
        # The config file is loaded, too.
        self.assertEqual(rospy.get_param('/serial_communication/mcu/max_range'), 2.0)
        self.assertEqual(rospy.get_param('/serial_communication/arduino/heartbeat_rate'), 100.0)
        command_topic('/serial_communication/speed', SpeedPWMCommand).publish(value=300)
        until(lambda: 300 in car.speeds, 'the car drives')
        self.end()
        until(lambda: car.raws[-1:] == [bytes.fromhex('0204010100')],
              'SPEED 0 is the last packet: %s' % car.raws[-3:])

    def test_an_empty_port_on_the_command_line_turns_its_link_off(self):
        self.launch_with_two_ports('mcu_port:=')
        self.assert_mcu_is_off()

    def test_a_single_empty_port_leaves_the_other_links_as_configured(self):
        self.open_two_lines()
        config = os.path.join(self.folder, 'robot.yaml')
        with open(config, 'w') as file:
            yaml.safe_dump({name: {'port': os.path.join(self.folder, name)}
                            for name in ('bus', 'arduino', 'mcu')}, file)
        self.launch('config:=' + config, 'mcu_port:=')
        self.assert_two_links_work()
        self.assert_mcu_is_off()

    def test_an_empty_port_of_an_including_file_turns_its_link_off(self):
        file = os.path.join(self.folder, 'robot.launch')
        for sim, ports in ('false', ['/dev/ttyS0', '/dev/ttyUSB0', '']), \
                ('true', ['/x/bus', '/x/arduino', '']):
            with open(file, 'w') as including:
                including.write(f'''<launch>
                    <include file="$(find {PACKAGE})/launch/bridge.launch">
                      <arg name="mcu_port" value=""/> <arg name="sim" value="{sim}"/>
                      <arg name="sim_dir" value="/x"/>
                    </include></launch>''')
            with self.subTest(sim=sim):
                self.assertEqual(self.ports(file), ports)

    def assert_mcu_is_off(self):
        """The bridge has no topic of the mcu link, and its parameter says so."""
        state = rosgraph.Master('/launch_test').getSystemState()[0]
        self.assertEqual([name for name, nodes in state if name.startswith('/mcu')
                          and '/serial_communication' in nodes], [])
        self.assertEqual(rospy.get_param('/serial_communication/mcu/port'), '')

    def test_with_one_port_argument_the_log_names_the_links_that_are_off(self):
        self.launch('arduino_port:=' + os.path.join(self.folder, 'arduino'))
        until(lambda: 'off, because no port is set: bus, mcu' in self.output_so_far(),
              'it says so')
        until(lambda: 'waiting for it' in self.output_so_far(), 'the other one is looked for')
        self.end()

    @staticmethod
    def parameters(*arguments):
        """The parameters that this launch would set, by name."""
        if not arguments or ':=' in arguments[0]:
            arguments = (PACKAGE, 'bridge.launch', *arguments)
        return yaml.safe_load(subprocess.check_output(['roslaunch', '--dump-params', *arguments]))

    def ports(self, *arguments):
        """The port of each link that this launch would set."""
        given = self.parameters(*arguments)
        return [given[f'/serial_communication/{link}/port'] for link in ('bus', 'arduino', 'mcu')]

    def test_values_of_sim_turn_the_simulation_on_or_off(self):
        for value, simulated in (('1', True), ('YES', True), ('on', True), ('True', True),
                                 ('avr', True), ('0', False), ('No', False), ('off', False),
                                 ('FALSE', False)):
            with self.subTest(sim=value):
                port = self.parameters('sim:=' + value)['/serial_communication/bus/port']
                self.assertEqual(port.startswith('/tmp/serial_communication-'), simulated, port)
                self.assertEqual(port == '/dev/ttyS0', not simulated, port)

    def test_one_port_argument_turns_the_links_without_one_off(self):
        for arguments, ports in (
                ([], ['/dev/ttyS0', '/dev/ttyUSB0', '/dev/ttyUSB1']),
                (['bus_port:=/dev/a'], ['/dev/a', '', '']),
                (['bus_port:=/dev/a', 'arduino_port:=/dev/b'], ['/dev/a', '/dev/b', '']),
                (['bus_port:=/dev/a', 'mcu_port:='], ['/dev/a', '', '']),
                (['bus_port:=/dev/a', 'mcu_port:=', 'arduino_port:=/dev/b'],
                 ['/dev/a', '/dev/b', ''])):
            with self.subTest(arguments):
                self.assertEqual(self.ports(*arguments), ports)

    def test_a_wrong_value_of_sim_ends_the_launch_with_a_clear_error(self):
        for value in 'maybe', '2', 'simulated':
            with self.subTest(sim=value):
                self.launch('sim:=' + value)
                self.assertNotEqual(self.process.wait(PATIENCE), 0)
                self.output.seek(0)
                text = self.output.read()
                self.assertIn('sim:=%s is wrong; it may be true, 1, yes, on, avr, false, 0, no '
                              'or off' % value, text)
                self.assertNotIn('process[', text, 'nothing was started')

    def test_two_launches_use_different_folders_for_their_boards(self):
        ports = [self.parameters('sim:=true')['/serial_communication/bus/port']
                 for _ in range(2)]
        self.assertNotEqual(*map(os.path.dirname, ports))
        # The longest path there, of a control socket, must be shorter than 108 characters.
        self.assertLess(len(os.path.dirname(ports[0])), 80)

    def test_a_simulated_bridge_with_another_name_and_a_frame_prefix(self):
        self.launch('sim:=1', 'name:=other', 'frame_prefix:=other/')
        imu = Topic('/other/imu', Imu).first()
        self.assertEqual(imu.header.frame_id, 'other/imu')
        port = rospy.get_param('/other/bus/port')
        self.assertTrue(port.startswith('/tmp/serial_communication-'), port)
        self.assertTrue(os.path.exists(port))
        self.end()
        until(lambda: not os.path.exists(os.path.dirname(port)), 'the folder is removed')

    def test_with_simulated_boards_every_topic_has_data_and_every_service_works(self):
        self.launch('sim:=true', 'sim_dir:=' + self.folder, 'publish_tf:=true')
        topics = [Topic(name, message_class) for name, message_class in SIMULATED_TOPICS]
        for topic in topics:
            topic.first()
        for link in 'bus', 'arduino', 'mcu':
            topics[0].first(lambda m, name=link: m.link == name, what='carries frames of ' + link)
        answers = [service('/serial_communication/lift', Lift)(0, 100),
                   service('/serial_communication/gimbal', Gimbal)(0, 30),
                   service('/serial_communication/get_environment', GetEnvironment)()]
        for answer in answers:
            self.assertTrue(answer.success, answer.message)
        self.assertEqual(service('/serial_communication/lift', Lift)(2, 100).status, 253)
        self.assertTrue(service('/serial_communication/bus/echo', Trigger)().success)
        found = Diagnostics().wait_for_all(('bus', 'arduino', 'mcu'),
                                           lambda s, _link: s.level == OK, 'OK')
        self.assertEqual(found['mcu'].hardware_id, os.path.join(self.folder, 'mcu'))
        until(lambda: len(topics[1].messages) >= 300, 'three hundred IMU messages')
        service('/serial_communication/calibrate_imu', Empty)()
        topics[3].first(lambda m: m.data)
        self.end()


if __name__ == '__main__':
    rospy.init_node('launch_test')
    rostest.rosrun(PACKAGE, 'launch', '__main__')
