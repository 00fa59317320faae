#!/usr/bin/python3
"""bridge.launch: ports on the command line, and simulated boards."""
import os
import signal
import subprocess
import tempfile
import unittest

import roslaunch
import rospy
import rostest
from sensor_msgs.msg import Imu, Range, RelativeHumidity, Temperature
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from boards import (NOT_SENT, OK, Output, PACKAGE, PATIENCE, SPEED_0_PACKET, BoardsTest, BusBoard,
                    CarBoard, Diagnostics, Topic, again_if_stalled, calibrates, command_topic,
                    service, until, until_in_step, wait_for_launch)
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


class Arguments(unittest.TestCase):
    """What a launch would set, without starting it."""

    @staticmethod
    def parameters(*arguments, path=None):
        """The parameters that this launch would set, by name."""
        path = path or roslaunch.rlutil.resolve_launch_arguments([PACKAGE, 'bridge.launch'])[0]
        config = roslaunch.config.load_config_default([(path, list(arguments))], None)
        return {name: parameter.value for name, parameter in config.params.items()}

    def ports(self, *arguments, **options):
        """The port of each link that this launch would set."""
        given = self.parameters(*arguments, **options)
        return [given[f'/serial_communication/{link}/port'] for link in ('bus', 'arduino', 'mcu')]

    def test_one_port_argument_turns_the_links_without_one_off(self):
        for arguments, ports in (
                ([], ['/dev/ttyS0', '/dev/ttyUSB0', '/dev/ttyUSB1']),
                (['bus_port:=/dev/a'], ['/dev/a', '', '']),
                (['bus_port:=/dev/a', 'arduino_port:=/dev/b'], ['/dev/a', '/dev/b', '']),
                (['bus_port:=/dev/a', 'mcu_port:='], ['/dev/a', '', '']),
                (['bus_port:=/dev/a', 'mcu_port:=', 'arduino_port:=/dev/b'],
                 ['/dev/a', '/dev/b', ''])):
            self.assertEqual(self.ports(*arguments), ports, arguments)

    def test_an_empty_port_of_an_including_file_turns_its_link_off(self):
        for sim, ports in ('false', ['/dev/ttyS0', '/dev/ttyUSB0', '']), \
                ('true', ['/x/bus', '/x/arduino', '']):
            with tempfile.NamedTemporaryFile('w', suffix='.launch') as including:
                including.write(f'''<launch>
                    <include file="$(find {PACKAGE})/launch/bridge.launch">
                      <arg name="mcu_port" value=""/> <arg name="sim" value="{sim}"/>
                      <arg name="sim_dir" value="/x"/>
                    </include></launch>''')
                including.flush()
                self.assertEqual(self.ports(path=including.name), ports, sim)

    def test_with_simulated_boards_no_real_port_is_used(self):
        for sim in 'true', 'avr':
            self.assertEqual(self.ports('sim:=' + sim, 'sim_dir:=/x', 'bus_port:=/dev/a'),
                             ['/x/bus', '/x/arduino', '/x/mcu'], sim)

    def test_a_wrong_value_of_sim_ends_the_launch_with_a_clear_error(self):
        with self.assertRaisesRegex(roslaunch.RLException, 'sim_is_true_false_or_avr/maybe'):
            self.parameters('sim:=maybe')

    def test_simulated_robots_under_one_master_have_different_ports_and_names(self):
        with tempfile.NamedTemporaryFile('w', suffix='.launch') as fleet:
            robots = ''.join(f'''<group ns="robot_{number}">
                <include file="$(find {PACKAGE})/launch/bridge.launch">
                  <arg name="name" value="bridge"/> <arg name="sim" value="true"/>
                </include></group>''' for number in range(3))
            fleet.write(f'<launch>{robots}</launch>')
            fleet.flush()
            config = roslaunch.config.load_config_default([(fleet.name, [])], None)
        ports = [each.value for name, each in config.params.items() if name.endswith('/port')]
        self.assertEqual((len(ports), len(set(ports))), (9, 9), ports)
        nodes = [each.namespace + each.name for each in config.nodes]
        self.assertEqual((len(nodes), len(set(nodes))), (12, 12), nodes)

    def test_two_launches_use_different_folders_for_their_boards(self):
        folders = [os.path.dirname(self.ports('sim:=true')[0]) for _ in range(2)]
        self.assertNotEqual(*folders)
        # The longest path there, of a control socket, must be shorter than 108 characters.
        self.assertLess(len(folders[0]), 80)


class Launch(BoardsTest):
    """roslaunch, started and ended as a user does."""

    process = None

    def tearDown(self):
        if self.process and self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            self.process.wait(PATIENCE)

    def launch(self, *arguments):
        """Run roslaunch serial_communication bridge.launch with these arguments; it is up then."""
        self.output = Output()
        self.process = subprocess.Popen(['roslaunch', PACKAGE, 'bridge.launch', *arguments],
                                        stdout=self.output, stderr=subprocess.STDOUT)
        wait_for_launch()

    def output_so_far(self):
        """The output of roslaunch and the bridge."""
        return self.output.text()

    def end(self):
        """Send Ctrl-C; the bridge then logs no warning, even if its boards end first."""
        before = len(self.output_so_far())
        self.process.send_signal(signal.SIGINT)
        status = self.process.wait(PATIENCE)
        text = self.output_so_far()
        self.assertEqual(status, 0, text)
        self.assertNotIn('Traceback', text)
        self.assertNotIn('escalating', text)
        self.assertNotIn('[WARN]', text[before:])
        self.assertNotIn('[ERROR]', text[before:])

    def plug_two(self):
        """Plug in a bus board and a car."""
        self.bus, self.car = self.plug('bus', BusBoard), self.plug('arduino', CarBoard)

    def assert_two_links_work(self):
        """Wait until both boards work."""
        until(lambda: service('/serial_communication/lift', Lift)(0, 100).success,
              'the lift answers')
        self.assertIn(bytes.fromhex('a50255200064b6'), self.bus.raws)
        Topic('/serial_communication/voltage', Voltage).first(
            doing=lambda: self.car.say(arduino.Voltage(12.0)))

    def test_ports_on_the_command_line_are_used_and_ctrl_c_ends_with_speed_0(self):
        self.plug_two()
        self.launch(*(f'{link}_port:={line.near}' for link, line in self.lines.items()))
        self.assert_two_links_work()
        # The config file is loaded, too.
        self.assertEqual(rospy.get_param('/serial_communication/mcu/max_range'), 2.0)
        self.assertEqual(rospy.get_param('/serial_communication/arduino/heartbeat_rate'), 100.0)
        speed = command_topic('/serial_communication/speed', SpeedPWMCommand)
        until(lambda: 300 in self.car.speeds, 'the car drives', every=0.1,
              doing=lambda: speed.publish(value=300))
        self.end()
        until(lambda: self.car.raws[-1:] == [SPEED_0_PACKET], 'SPEED 0 is the last packet')

    def test_with_simulated_boards_every_topic_has_data_and_every_service_works(self):
        self.launch('sim:=true', 'publish_tf:=true')
        topics = [Topic(name, message_class) for name, message_class in SIMULATED_TOPICS]
        for topic in topics:
            topic.first()
        for link in 'bus', 'arduino', 'mcu':
            topics[0].first(lambda m, name=link: m.link == name, what='carries frames of ' + link)
        for name, kind, arguments in (('lift', Lift, (0, 100)), ('gimbal', Gimbal, (0, 30)),
                                      ('get_environment', GetEnvironment, ()),
                                      ('bus/echo', Trigger, ())):
            call = service('/serial_communication/' + name, kind)

            def succeeds(call=call, arguments=arguments):
                until_in_step(PACKAGE)
                return call(*arguments).success
            again_if_stalled(succeeds)
        self.assertEqual(service('/serial_communication/lift', Lift)(2, 100).status, NOT_SENT)
        port = rospy.get_param('/serial_communication/mcu/port')
        self.assertTrue(port.startswith('/tmp/boards_'), port)
        found = Diagnostics().wait_for_all(('bus', 'arduino', 'mcu'),
                                           lambda s, _link: s.level == OK, 'OK')
        self.assertEqual(found['mcu'].hardware_id, port)
        until(calibrates, 'the board calibrates', every=0.1)
        topics[3].first(lambda m: m.data)
        self.end()
        until(lambda: not os.path.lexists(port), 'the port is removed')


if __name__ == '__main__':
    rospy.init_node('launch_test')
    rostest.rosrun(PACKAGE, 'launch', '__main__')
