#!/usr/bin/python3
"""Boards that announce their custom messages: what they add appears, changes and goes while the
bridge runs, and nothing else notices."""
import os
import shutil
import struct
import unittest

import rosgraph
import rospy
import rostest
from std_msgs.msg import Bool, Float32, UInt16
from std_srvs.srv import SetBool, Trigger

from boards import (PACKAGE, Bridge, BusBoard, CarBoard, Diagnostics, Line, Rosout, SensorBoard,
                    Topic, command_topic, own_folder, service, until)
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.framing.announcement import TYPE
from serial_communication.simulation.announcing import chunks_of
from serial_communication.msg import Ticks

NODE = '/' + PACKAGE + '/'
FORCE = 'force: {type: 32, ros_type: std_msgs/Float32, layout: "<h", fields: [data], scale: 0.01}\n'
LEVEL = 'level: {type: 33, ros_type: std_msgs/UInt16, layout: "<H", fields: [data]}\n'
GRIPPER = ('gripper: {type: 48, direction: to_board, ros_type: std_msgs/UInt16, layout: "<H", '
           'fields: [data]}\n')
FIRMWARE = 'firmware: nano_car 1.1.0\n'
PUMP = ('pump: {cmd2: 0x40, srv_type: std_srvs/SetBool, '
        'request: {layout: "<?", fields: [data]}}\n')
TANK = ('tank: {cmd2: 0x41, ros_type: std_msgs/Float32, period: 0.05, '
        'reply: {layout: "<H", fields: [data], scale: 0.1}}\n')


class AnnouncingBus(BusBoard):
    """A control board with a pump and a tank, which announces `text`."""

    text = FIRMWARE + PUMP + TANK

    def usual(self, request):
        if request.cmd1 == bus.FUNCTION and request.cmd2 == TYPE:
            chunks = chunks_of(self.text.encode(), 40)
            return bus.Reply(bus.OK, chunks[request.data[0]].pack()) if self.text else \
                bus.Reply(bus.ERROR, b'\0\x80')
        if request.cmd1 == bus.FUNCTION and request.cmd2 == 0x41:
            self.executed.append(request)
            return bus.Reply(bus.OK, b'\x0f\x00')
        return super().usual(request)


def published():
    """The names of all topics that the bridge publishes or subscribes to, and its services."""
    return {name for entries in rosgraph.Master('/announced_test').getSystemState()
            for name, nodes in entries if '/' + PACKAGE in nodes}


class AnnouncedTest(unittest.TestCase):
    """A bridge that uses all announcements, and has two rows in its parameters."""

    @classmethod
    def setUpClass(cls):
        cls.folder = own_folder()
        cls.lines = {link: Line(os.path.join(cls.folder, link)).plug()
                     for link in ('bus', 'arduino', 'mcu')}
        cls.bus = AnnouncingBus(cls.lines['bus'].far)
        cls.car = CarBoard(cls.lines['arduino'].far)
        cls.sensors = SensorBoard(cls.lines['mcu'].far)
        row = {'ros_type': 'std_msgs/Bool', 'layout': '<?', 'fields': ['data']}
        cls.bridge = Bridge(parameters={
            **{f'{link}/port': line.near for link, line in cls.lines.items()},
            'arduino/network_silence': 0.0,     # no heartbeat is dropped when this test is slow
            'bus/environment_period': 0.05, 'bus/announcements': True,
            'arduino/speed_timeout': 0.0, 'publish_tf': True,
            'arduino/messages': {'mine': dict(row, type=40), 'same': dict(row, type=41)}})
        cls.rosout, cls.diagnostics = Rosout(), Diagnostics()
        until(lambda: {NODE + 'pump', NODE + 'tank', NODE + 'calibrate_imu'} <= published(),
              'the bridge is complete, and the bus board announces')
        cls.car.wait_for_heartbeats(1)

    @classmethod
    def tearDownClass(cls):
        cls.bridge.end()
        for part in cls.rosout, cls.diagnostics, cls.bus, cls.car, cls.sensors:
            part.close()
        for line in cls.lines.values():
            line.unplug()
        shutil.rmtree(cls.folder)

    def setUp(self):
        self.car.forget()
        self.rosout.forget()
        self.diagnostics.forget()

    def tearDown(self):
        if self.parameter():
            self.announce('')

    def say(self, text, size=60, board=None):
        """A function that announces a text once: the car's, or another board's."""
        board = board or self.car
        return lambda: [board.say(chunk) for chunk in chunks_of(text.encode(), size)]

    def announce(self, text, link='arduino'):
        """Announce a text until the bridge says that it uses it."""
        names = [line.split(':')[0] for line in text.splitlines()
                 if not line.startswith('firmware')]
        board = {'arduino': self.car, 'mcu': self.sensors}[link]
        self.rosout.forget()
        said = self.rosout.wait_for(PACKAGE, 'announces ' + (', '.join(names) or 'nothing'),
                                    doing=self.say(text, board=board))
        self.until_parameter_has(*names, link=link)
        return said

    def until_parameter_has(self, *names, link='arduino'):
        """Wait for the announced rows on the parameter server: they come after the log line."""
        until(lambda: set(self.parameter(link) or ()) == set(names),
              f'the parameter of {link} has {names}', every=0.05)

    def topic(self, name, message_class):
        """A record of a topic, which is closed when the test ends."""
        topic = Topic(NODE + name, message_class, wait=False)
        self.addCleanup(topic.close)
        return topic

    def parameter(self, link='arduino'):
        """The announced rows on the parameter server."""
        return rospy.get_param(NODE + link + '/announced', None)

    def reconnects(self):
        """How often the bridge has opened the car's port again."""
        status = self.diagnostics.fresh('arduino', lambda status: True, 'a status')
        return int(status.keys['reconnects'])

    def unplug(self, link):
        """Cut a line, and wait until the bridge has noticed."""
        self.lines[link].unplug()
        self.diagnostics.fresh(link, lambda status: status.level == 2
                               and 'closed' in status.message, 'a closed port')

    def send(self, type_, data):
        """A function that sends a packet of the car."""
        return lambda: self.car.write(arduino.encode_raw(type_, data))

    # -- the car ---------------------------------------------------------------------------------

    def test_topics_and_commands_appear_and_carry_values(self):
        before = published()
        line = self.announce(FIRMWARE + FORCE + GRIPPER)
        self.assertEqual(line, 'arduino: announces force, gripper (firmware nano_car 1.1.0)')
        self.assertEqual(published() - before, {NODE + 'force', NODE + 'gripper'})
        force = self.topic('force', Float32)
        force.first(lambda message: abs(message.data - 12.34) < 1e-4,
                    self.send(32, struct.pack('<h', 1234)))
        gripper = command_topic(NODE + 'gripper', UInt16)
        self.addCleanup(gripper.unregister)
        until(lambda: arduino.encode_raw(48, b'\1\2') in [frame.raw for frame in self.car.bad],
              'the board gets the command', doing=lambda: gripper.publish(513), every=0.05)
        self.assertEqual(self.parameter(), {
            'force': {'type': 32, 'ros_type': 'std_msgs/Float32', 'layout': '<h',
                      'fields': ['data'], 'scale': 0.01},
            'gripper': {'type': 48, 'direction': 'to_board', 'ros_type': 'std_msgs/UInt16',
                        'layout': '<H', 'fields': ['data']}})
        self.diagnostics.wait_for('arduino', lambda status: (
            status.keys.get('firmware'), status.keys.get('announced')) == (
                'nano_car 1.1.0', 'force, gripper'), 'they are shown')

    def test_what_changes_is_replaced_and_what_went_is_taken_down_and_nothing_else_notices(self):
        self.announce(FORCE + GRIPPER)
        force, ticks = self.topic('force', Float32), self.topic('ticks', Ticks)
        speak = self.send(32, struct.pack('<h', 100))
        force.first(doing=speak)
        publications = force._subscriber.impl.connections[:]
        reconnects = self.reconnects()
        number = [0]

        def busy():
            """Ticks that count, and force, while everything else changes."""
            self.car.say(arduino.Ticks(number[0] % 256))
            number[0] += 1
            speak()

        self.rosout.forget()
        self.rosout.wait_for(PACKAGE, 'announces force, level', doing=lambda: (
            busy(), self.say(FORCE + LEVEL)()))
        self.assertNotIn(NODE + 'gripper', published())
        level = self.topic('level', UInt16)
        level.first(lambda message: message.data == 7, self.send(33, b'\7\0'))
        level.close()       # rospy has one type for a name in a process
        self.announce(FORCE + LEVEL.replace('UInt16', 'Bool'))
        changed = self.topic('level', Bool)
        changed.first(lambda message: message.data is True, self.send(33, b'\7\0'))
        self.assertEqual(force._subscriber.impl.connections, publications)
        force.next(lambda message: message.data == 1.0, doing=speak)
        end = number[0] % 256       # a stall may drop the last one: wait for one after it
        until(lambda: ticks.messages and (ticks.messages[-1].value - end) % 256 < 128,
              'all of these ticks have arrived', doing=busy, every=0.05)
        received = [message.value for message in list(ticks.messages)]
        status = self.diagnostics.fresh('arduino', lambda status: True, 'a status')
        if status.keys['stale'] == '0':     # else this machine stalled the bridge
            self.assertEqual(received, [value % 256 for value in range(
                received[0], received[0] + len(received))])
        self.announce('')
        self.assertEqual(published() & {NODE + 'force', NODE + 'level'}, set())
        self.assertEqual(self.parameter(), {})
        self.assertEqual(self.reconnects(), reconnects)
        self.diagnostics.wait_for('arduino', lambda status: status.keys['announced'] == '',
                                  'no row')

    # -- the other boards --------------------------------------------------------------------------

    def test_services_and_polls_of_a_bus_board_appear_change_and_go(self):
        before = self.bus.text
        pump = service(NODE + 'pump', SetBool)
        answer = until(lambda: self.call(pump, True), 'the pump runs')
        self.assertTrue(answer.success)
        self.assertIn(bus.Request(bus.FUNCTION, 0x40, b'\1'), self.bus.executed)
        tank = self.topic('tank', Float32)
        tank.first(lambda message: abs(message.data - 1.5) < 1e-6)
        self.until_parameter_has('pump', 'tank', link='bus')
        self.unplug('bus')
        self.bus.text = FIRMWARE + PUMP.replace('SetBool', 'Trigger').replace(
            ', request: {layout: "<?", fields: [data]}', '')
        self.rosout.forget()
        self.lines['bus'].plug()
        self.assertEqual(self.rosout.wait_for(PACKAGE, 'announces'),
                         'bus: announces pump (firmware nano_car 1.1.0)')
        self.assertNotIn(NODE + 'tank', published())
        answer = until(lambda: self.call(service(NODE + 'pump', Trigger)), 'the pump answers')
        self.assertTrue(answer.success)
        self.assertIn(bus.Request(bus.FUNCTION, 0x40), self.bus.executed)
        for text, line in ('', 'bus: announces nothing'), (before, 'bus: announces pump, tank'):
            self.unplug('bus')
            self.bus.text = text
            self.lines['bus'].plug()
            self.rosout.wait_for(PACKAGE, line)
            self.assertEqual(NODE + 'pump' in published(), bool(text))

    @staticmethod
    def call(proxy, *arguments):
        """The answer if the call succeeds, else None."""
        try:
            answer = proxy(*arguments)
        except rospy.ServiceException:
            return None
        return answer if answer.success else None

    def test_a_name_that_another_link_has_is_left_out(self):
        service(NODE + 'pump', SetBool)
        self.rosout.forget()
        self.rosout.wait_for(PACKAGE, 'arduino: announces force',
                             doing=self.say(FORCE + LEVEL.replace('level', 'pump')))
        self.assertEqual(len(self.rosout.lines(
            PACKAGE, "arduino/announced/pump is 'pump' (str), has the name of bus/announced/pump")),
            1)


if __name__ == '__main__':
    rospy.init_node('announced_test')
    rostest.rosrun(PACKAGE, 'announced', __name__)
