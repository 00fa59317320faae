#!/usr/bin/python3
"""The life of a bridge: start, mistakes, a name that is taken, a new master, the end, a log that
cannot be written, simulated time, and the launch files."""
import os
import signal
from functools import partial
from multiprocessing.pool import ThreadPool
from pathlib import Path

import rosgraph
import rosnode
import rospy
import rostest
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from boards import (NODE, NOT_SENT, PACKAGE, SPEED_0_PACKET, SYNC_FRAME, TIMEOUT,
                    BoardsTest, Bridge, BusBoard, CarBoard, Diagnostics, Line, Master, Process,
                    SensorBoard, Topic, again_if_stalled, command_topic, names_of, service, settle,
                    until, wait_for_launch)
from by_definition import ENVIRONMENT, announcement, arduino_packet
from contract_published import OF_ROS, PUBLISHED, SERVICES, SUBSCRIBED
from contract_robot import resolved
from publishers import FakePublisher
from serial_communication.msg import SpeedPWMCommand, Voltage
from serial_communication.srv import GetEnvironment, Gimbal, Lift

KINDS = {'bus': BusBoard, 'arduino': CarBoard, 'mcu': SensorBoard}
TAKEN = 3                # exit status if a node of the same name is running
ROWS = (b'force: {type: 32, ros_type: std_msgs/Float32, layout: "<h", fields: [data]}\n'
        b'kp: {setting: 1, layout: "<f"}')
FORCE = {'type': 32, 'ros_type': 'std_msgs/Flot32', 'layout': '<h', 'fields': ['data']}
# By the node's name: parameters, arguments, and what the one line says; NODE is the node.
MISTAKES = {
    'range': ({'frame_timeout': 'soon'}, [], [
        "parameter NODE/frame_timeout is 'soon'", 'a number from 0.001 to 10 (s)']),
    'url': ({'bus/port': 'socket://robot'}, [], ["parameter NODE/bus/port is 'socket://robot'"]),
    'group': ({'arduino': 'off'}, [], ["parameter NODE/arduino is 'off'",
                                       'a group of parameters']),
    'row': ({'arduino/messages': {'force': FORCE}}, [], [
        "parameter NODE/arduino/messages/force/ros_type is 'std_msgs/Flot32'"]),
    'same_port': ({'bus/port': '/dev/null', 'mcu/port': '/dev/../dev/null'}, [], [
        "parameter NODE/mcu/port is '/dev/../dev/null'", 'bus']),
    'remapped': ({'arduino/port': '/absent'}, ['~speed:=~steering'],
                 ['NODE/steering is the name of ']),
    'mcu': ({'arduino/port': '/absent', 'mcu/port': '/absent/mcu'}, [],
            ['NODE/imu is the name of ']),
}


def stopped(car):
    """Wait until SPEED 0 is the last packet."""
    until(lambda: car.raws[-1:] == [SPEED_0_PACKET], 'SPEED 0 is the last packet')


def drive(car, name=PACKAGE, value=400):
    """Let a car drive."""
    speed = rospy.Publisher(f'/{name}/speed', SpeedPWMCommand, queue_size=1)
    until(lambda: value in car.speeds, 'the car drives', every=0.05,
          doing=lambda: speed.publish(value=value))
    speed.unregister()


class Start(BoardsTest):
    """Bridges whose ports come later, or never."""

    def test_each_link_works_alone_and_waits_for_its_port(self):
        bridges = {}
        for link in (*KINDS, ''):
            self.lines[link] = Line(os.path.join(self.folder, link))
            given = {f'{link}/port': self.lines[link].near} if link else {}
            bridges[link] = self.start(Bridge, f'only_{link}', {
                **given, 'bus/environment_period': 0.0})
        for link, bridge in bridges.items():
            node, links = f'/only_{link}', ('', link) if link else ('',)
            expected = [{resolved(name, node) for each in links for name in table.get(each, ())}
                        for table in (PUBLISHED, SUBSCRIBED, SERVICES)]
            until(lambda e=expected, n=node: names_of(n)[2] >= e[2], f'services of {node}')
            of_ros = {resolved(name, node) for name in OF_ROS}
            self.assertEqual([names - of_ros for names in names_of(node)], expected)
            self.assertTrue(bridge.alive)
        self.assertEqual(service('/only_bus/lift', Lift)(0, 1).status, NOT_SENT)
        statuses = {link: Diagnostics(f'only_{link}') for link in KINDS}
        boards = {}
        for condition in 'closed', 'open':
            for link, kind in KINDS.items():
                if condition == 'open':
                    self.lines[link].plug()
                    self.addCleanup(self.lines[link].unplug)
                    boards[link] = kind(self.lines[link].far)
                    self.addCleanup(boards[link].close)
                statuses[link].wait_for(link, lambda status, c=condition: (
                    status.keys['condition'] == 'closed') == (c == 'closed')
                    and status.keys['reconnects'] == '0', condition, is_fresh=False)
        until(lambda: service('/only_bus/lift', Lift)(0, 1).success, 'the lift answers')
        self.assertEqual(boards['bus'].asked(ENVIRONMENT), [], 'a period of 0 is never')
        self.assertEqual(boards['bus'].asked(0xFF), [], 'no board is asked what it announces')

    def test_a_mistake_ends_the_node_with_one_line(self):
        def ended(name):
            parameters, arguments, _ = MISTAKES[name]
            bridge = self.start(Bridge, name, parameters, arguments)
            return bridge.ended(), bridge.output()
        with ThreadPool(2) as pool:
            results = pool.map(ended, MISTAKES)
        for (name, (_, _, said)), (status, output) in zip(MISTAKES.items(), results):
            self.assertEqual(status, 1, output)
            line, = [line for line in output.split('\n') if line.strip() and '[INFO]' not in line]
            for words in said:
                self.assertIn(words.replace('NODE', f'/{name}'), line)

    def test_what_a_board_of_another_package_raises_ends_the_node(self):
        Path(self.folder, 'fails.py').write_text('1 / 0\n')
        bridge = self.start(Bridge, parameters={'boards': ['fails']},
                            PYTHONPATH=f'{self.folder}:{os.environ["PYTHONPATH"]}')
        self.assertEqual(bridge.ended(), 1)
        self.assertTrue(bridge.output().rstrip().endswith('ZeroDivisionError: division by zero'))

    def test_a_second_bridge_of_a_name_ends_and_the_first_goes_on(self):
        car = self.plug('arduino', CarBoard)
        first = self.start(Bridge, parameters=self.ports())
        car.wait_for_heartbeats(10)
        address = until(lambda: rosgraph.Master('/test').lookupNode(NODE), 'it is registered')
        second = self.start(Bridge, parameters=self.ports())
        self.assertEqual(second.ended(), TAKEN)
        line, = second.output().strip().split('\n')
        self.assertIn(f'{NODE} is already running', line)
        car.wait_for_heartbeats(50)
        self.assertTrue(first.alive)
        self.assertEqual(rosgraph.Master('/test').lookupNode(NODE), address)
        self.assertEqual(car.speeds, [])

    def test_commands_latched_before_the_start_are_refused_and_an_age_of_0_takes_any_stamp(self):
        """Of the same bridge: what its car announces is ignored, as the parameter says."""
        old = FakePublisher('/old', f'{NODE}/speed', SpeedPWMCommand, latching=True)
        self.addCleanup(old.close)
        car = self.plug('arduino', CarBoard, announcement=ROWS)
        self.start(Bridge, parameters={**self.ports(), 'arduino/command_age': 0.0,
                                       'arduino/announcements': False})
        car.wait_for_heartbeats(10)
        old.say(SpeedPWMCommand(value=500))     # the first message on the connection
        for value, stamp in (501, 1.0), (502, 4e9):
            command = SpeedPWMCommand(value=value)
            command.header.stamp = rospy.Time.from_sec(stamp)
            until(lambda v=value: v in car.speeds, f'speed {value}', every=0.1,
                  doing=lambda c=command: old.say(c))
        self.assertNotIn(500, car.speeds)
        car.wait_for_heartbeats(100)
        self.assertNotIn(NODE + '/force', names_of()[0])


class NewMaster(BoardsTest):
    """A master that ends, and a new one in its place."""

    def test_the_bridge_starts_again_with_its_parameters_and_a_stop_that_held_holds(self):
        car = self.plug('arduino', CarBoard)
        master = Master().start()
        self.addCleanup(master.end)
        bridge = self.start(Bridge, master=master.uri, parameters={
            **self.ports(), 'arduino/speed_timeout': 0.7, 'settings/arduino/kp': 2.0})

        def announce():
            for chunk in announcement(ROWS, 50):
                car.write(arduino_packet(255, chunk))

        def complete():
            names = names_of(NODE, master.server)
            return NODE + '/force' in names[0] and NODE + '/stop' in names[2] and names \
                if NODE + '/settings/arduino/set_parameters' in names[2] else None

        def call(name, request):
            process = self.start(Process, 'rosservice', 'call', f'{NODE}/{name}', request,
                                 ROS_MASTER_URI=master.uri)
            process.ended()
            return process.output()
        before = until(complete, 'the rows are in use', doing=announce, every=0.2)
        until(lambda: 'success: True' in call('stop', 'data: true'), 'it is stopped')
        until(lambda: SPEED_0_PACKET not in car.raws[-30:], 'its repetitions are over')
        master.end()
        car.forget()
        car.wait_for_heartbeats(100)       # a master that is gone changes nothing
        self.assertEqual(car.speeds, [])
        self.assertNotIn(SPEED_0_PACKET, car.raws[50:])
        master.start()
        bridge.wait_for('is a new ROS master')
        until(lambda: complete() == before, 'all names are back', doing=announce, every=0.2)
        self.assertIn(SPEED_0_PACKET, car.raws)
        for key, value in (('arduino/port', self.lines['arduino'].near),
                           ('arduino/speed_timeout', 0.7), ('settings/arduino/kp', 2.0),
                           ('arduino/announced/force/type', 32)):
            until(lambda k=key: master.server.hasParam(f'{NODE}/{k}'), f'{key} is set')
            self.assertEqual(master.server.getParam(f'{NODE}/{key}'), value)
        self.assertIn('stopped: call ~stop with data: false', call('calibrate_imu', '{}'))
        self.assertEqual(bridge.output().count('is a new ROS master'), 1)
        self.assertEqual(bridge.end(), 0, bridge.output())
        self.assertNotIn('Traceback', bridge.output())


class Ends(BoardsTest):
    """Bridges whose cars drive."""

    def test_every_end_is_in_order_and_stops_the_car(self):
        ends = {'sigint': signal.SIGINT, 'sigterm': signal.SIGTERM, 'sighup': signal.SIGHUP,
                'killed': None}
        cars = {name: self.plug(name, CarBoard) for name in ends}
        bridges = {name: self.start(Bridge, name, {'arduino/port': self.lines[name].near})
                   for name in ends}
        for name, number in ends.items():
            drive(cars[name], name)
            if number is None:
                rosnode.kill_nodes(['/' + name])
                status = bridges[name].ended()
            else:
                status = bridges[name].end(number)
            self.assertEqual(status, 0, bridges[name].output())
            self.assertNotIn('Traceback', bridges[name].output())
            stopped(cars[name])


class Log(BoardsTest):
    """A terminal or a pipe that takes no log."""

    def test_a_log_that_cannot_be_written_holds_nothing_up(self):
        for spoil in self.close_reader, self.fill:
            with self.subTest(spoil.__name__):
                self.assert_works(spoil)

    @staticmethod
    def close_reader(reading, _writing):
        """The reader of the pipe has exited."""
        os.close(reading)

    @staticmethod
    def fill(reading, writing):
        """The reader of the pipe does not read, like a terminal after Ctrl-S."""
        # Open it again, since O_NONBLOCK would otherwise apply to the bridge, too.
        again = os.open(f'/proc/self/fd/{writing}', os.O_WRONLY | os.O_NONBLOCK)
        for size in 4096, 1:
            try:
                while True:
                    os.write(again, bytes(size))
            except BlockingIOError:
                pass
        os.close(again)

    def assert_works(self, spoil):
        reading, writing = os.pipe()
        car = self.plug('arduino', CarBoard)
        bridge = self.start(Bridge, parameters=self.ports(), stdout=writing)
        voltage = Topic(NODE + '/voltage', Voltage)
        self.addCleanup(voltage.close)

        def flows():
            voltage.next(doing=lambda: car.write(arduino_packet(10, b'\0\0\x40\x41')))
        flows()
        spoil(reading, writing)
        self.lines['arduino'].unplug()
        until(lambda: not voltage.publishers or not car.connected, 'it is unplugged')
        self.lines['arduino'].plug()
        flows()
        car.write(bytes(range(1, 200)) * 5)     # noise, which is logged
        car.wait_for_heartbeats(50)
        flows()
        self.assertEqual(bridge.end(), 0)
        stopped(car)
        os.close(writing)


class SimulatedTime(BoardsTest):
    """A bridge with /use_sim_time; this node has the time of the computer."""

    def test_all_works_while_time_stands_still_and_then_stamps_and_ages_follow_the_clock(self):
        rospy.set_param('/use_sim_time', True)
        self.addCleanup(rospy.delete_param, '/use_sim_time')
        bus, car = self.plug('bus', BusBoard), self.plug('arduino', CarBoard, measures=True)
        self.plug('mcu', SensorBoard, measures=True)
        self.start(Bridge, parameters={**self.ports(), 'bus/motion_timeout': 0.5,
                                       'publish_tf': True, 'bus/environment_period': 0.1})
        lift, reading = (service(f'{NODE}/{name}', kind) for name, kind in (
            ('lift', Lift), ('get_environment', GetEnvironment)))
        for script, status in ([], 2), ([b''], TIMEOUT):
            def answered(script=script, status=status):
                settle(PACKAGE, bus)
                bus.script += script
                return lift(0, 100).status == status
            again_if_stalled(answered)
        until(lambda: reading().success, 'a reading')
        drive(car)
        until(lambda: car.speeds[-1] == 0, 'SPEED 0')
        topics = {name: Topic(name, kind) for name, kind in (
            (NODE + '/imu', Imu), ('/mcu/imu', Imu), ('/tf', TFMessage))}

        def stamp(name):
            """The stamp of the newest message."""
            message = topics[name].next()
            return (message.transforms[0] if name == '/tf' else message).header.stamp.to_sec()
        self.assertEqual(list(map(stamp, topics)), [0.0] * 3)
        diagnostics = Diagnostics()
        for link in KINDS:
            diagnostics.wait_for(link, lambda status: True, 'once a second')
        clock = rospy.Publisher('/clock', Clock, queue_size=1)
        until(clock.get_num_connections, 'the bridge hears the clock')
        speed = command_topic(NODE + '/speed', SpeedPWMCommand)

        def say(value, at):
            command = SpeedPWMCommand(value=value)
            command.header.stamp = rospy.Time.from_sec(at)
            speed.publish(command)
        for turn, now in enumerate((1000.0, 50.0), 1):     # it jumps back, as a bag played again
            for name in topics:
                until(lambda n=name, t=now: abs(stamp(n) - t) < 1.0, f'stamps of {now} on {name}',
                      doing=partial(clock.publish, rospy.Time.from_sec(now)))
            car.forget()
            for value, at in (30 + turn, now - 1.0), (40 + turn, now + 40.0):
                say(value, at)
            until(lambda v=turn: v in car.speeds, 'the speed', every=0.05,
                  doing=lambda v=turn, t=now: say(v, t))
            self.assertFalse({30 + turn, 40 + turn} & set(car.speeds))


class Launch(BoardsTest):
    """roslaunch, started and ended as a user does."""

    def launch(self, *arguments):
        """Run roslaunch with a launch file of the package; its bridge is up then."""
        self.process = self.start(Process, 'roslaunch', PACKAGE, *arguments)
        self.addCleanup(self.interrupt)
        wait_for_launch()

    def interrupt(self):
        """Send Ctrl-C, so that its nodes end, too."""
        return self.process.end() if self.process.alive else self.process.process.returncode

    def assert_ends(self):
        """Ctrl-C ends all of it in order, without a warning but the boards'."""
        before = len(self.process.output())
        status = self.interrupt()
        text = self.process.output()
        self.assertEqual(status, 0, text)
        self.assertNotRegex(text, 'Traceback|escalating')
        self.assertEqual([line for line in text[before:].split('\n') if 'arduino says' not in line
                          and ('[WARN]' in line or '[ERROR]' in line)], [])

    def test_ports_on_the_command_line_are_used_and_ctrl_c_ends_with_speed_0(self):
        bus, car = self.plug('bus', BusBoard), self.plug('arduino', CarBoard)
        self.launch('bridge.launch', *(f'{link}_port:={line.near}'
                                       for link, line in self.lines.items()))
        until(lambda: service(NODE + '/lift', Lift)(0, 100).success, 'the lift answers')
        self.assertEqual(bytes(bus.wire[:5]), SYNC_FRAME)
        self.assertEqual(rospy.get_param(NODE + '/mcu/max_range'), 2.0)      # of the file
        drive(car)
        self.assert_ends()
        stopped(car)

    def test_with_simulated_boards_every_topic_has_data_and_every_service_works(self):
        self.launch('bridge.launch', 'sim:=true')
        for link in KINDS:
            for name, kind in PUBLISHED[link].items():
                if name != 'mcu/adc_status':
                    topic = Topic(resolved(name), kind)
                    topic.first()
                    topic.close()
        for name, kind, arguments in (
                ('lift', Lift, (0, 100)), ('gimbal', Gimbal, (0, 30)),
                ('get_environment', GetEnvironment, ()), ('bus/echo', Trigger, ())):
            call = service(f'{NODE}/{name}', kind)
            until(lambda c=call, a=arguments: c(*a).success, name, every=0.2)
        self.assertNotIn(NODE, dict(rosgraph.Master('/test').getSystemState()[0]).get('/tf', []))
        port = rospy.get_param(NODE + '/mcu/port')
        self.assertTrue(port.startswith('/tmp/boards_'), port)
        self.assert_ends()
        until(lambda: not os.path.lexists(port), 'the port is removed')

    def test_diff_drive_has_cmd_vel_and_odom_of_a_base_that_announces_them(self):
        rows = b"""odom: {type: 64, ros_type: nav_msgs/Odometry, layout: "<hhh", fields: [\
pose.pose.position.x, pose.pose.position.y, pose.pose.orientation.yaw], scale: 0.001, \
frame_id: odom, child_frame_id: base_link}
cmd_vel: {type: 65, direction: to_board, ros_type: geometry_msgs/Twist, layout: "<hh", \
fields: [linear.x, angular.z], scale: 0.001}
"""
        base = self.plug('base', CarBoard, announcement=rows)
        self.launch('diff_drive.launch', 'port:=' + self.lines['base'].near)
        command, transforms = Twist(), Topic('/tf', TFMessage, wait=False)
        command.linear.x, command.angular.z = 0.3, -1.0
        drives = rospy.Publisher('/cmd_vel', Twist, queue_size=1)
        moves = arduino_packet(65, b'\x2c\1\x18\xfc')
        until(lambda: moves in base.wire, 'it drives', doing=lambda: drives.publish(command),
              every=0.05)
        odometry = Topic('/odom', Odometry)
        pose = arduino_packet(64, b'\xe8\3\0\0\0\0')
        message = odometry.first(doing=lambda: base.write(pose))
        self.assertEqual((message.header.frame_id, message.child_frame_id,
                          message.pose.pose.position.x), ('odom', 'base_link', 1.0))
        transforms.first(lambda m: m.transforms[0].child_frame_id == 'base_link',
                         doing=lambda: base.write(pose))
        base.wire.clear()
        until(lambda: arduino_packet(65, bytes(4)) in base.wire, 'its zero, as nobody drives')
        self.assert_ends()


if __name__ == '__main__':
    rospy.init_node('lifecycle_test')
    rostest.rosrun(PACKAGE, 'lifecycle', '__main__')
