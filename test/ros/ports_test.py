#!/usr/bin/python3
"""Ports that are absent, no ports at all, vanish, or return elsewhere: the node lives, /diagnostics
says so, data flows again, and nothing old is sent."""
import os
import shutil
import unittest

import rospy
import rostest
from std_srvs.srv import Trigger

from boards import (ERROR, NOT_SENT, OK, PACKAGE, SYNC_FRAME, Bridge, BusBoard, CarBoard,
                    Diagnostics, Line, SensorBoard, Topic, level_imu, own_folder, ranges, service,
                    until)
from serial_communication.msg import McuStatus2, Voltage
from serial_communication.boards.arduino import wire as arduino
from serial_communication.srv import Lift

LINKS = 'bus', 'arduino', 'mcu'


class PortsTest(unittest.TestCase):
    """A bridge with three links, and lines that a test plugs and unplugs."""

    name = PACKAGE

    @classmethod
    def setUpClass(cls):
        cls.folder = own_folder()
        cls.lines = {link: Line(os.path.join(cls.folder, link)) for link in LINKS}
        cls.boards = {}
        parameters = {link + '/port': line.near for link, line in cls.lines.items()}
        parameters.update(cls.parameters())
        cls.bridge = Bridge(cls.name, parameters)
        cls.lift = service('/%s/lift' % cls.name, Lift)
        cls.echo = service('/%s/bus/echo' % cls.name, Trigger)
        cls.voltage = Topic('/%s/voltage' % cls.name, Voltage)
        cls.status = Topic('/mcu/status', McuStatus2)
        cls.diagnostics = Diagnostics(cls.name)

    @classmethod
    def tearDownClass(cls):
        cls.bridge.end()
        for topic in cls.voltage, cls.status, cls.diagnostics:
            topic.close()
        for board in cls.boards.values():
            board.close()
        for line in cls.lines.values():
            line.unplug()
        shutil.rmtree(cls.folder)

    @classmethod
    def parameters(cls):
        """Others than the defaults."""
        return {'bus/motion_timeout': 20.0, 'bus/environment_period': 0.0,
                'bus/reply_timeout': 0.3}

    def plug(self, *links):
        """Connect the lines, with the boards at their far ends."""
        for link in links or LINKS:
            self.lines[link].plug()
        self.wait_for_boards(*links)

    def wait_for_boards(self, *links):
        for link in links or LINKS:
            if link not in self.boards:
                self.boards[link] = {'bus': BusBoard, 'arduino': CarBoard,
                                     'mcu': SensorBoard}[link](self.lines[link].far)
            until(lambda b=self.boards[link]: b.connected, '%s board is there' % link)

    def assert_flows(self, *links):
        """New data goes through each link, from its board to ROS."""
        if 'bus' in (links or LINKS):
            until(lambda: self.lift(0, 1).success, 'the lift answers')
        if 'arduino' in (links or LINKS):
            self.voltage.next(doing=lambda: self.boards['arduino'].say(arduino.Voltage(12.0)))
        if 'mcu' in (links or LINKS):
            self.status.next(lambda m: m.connected,
                             doing=lambda: self.boards['mcu'].say(ranges()))
        self.assertTrue(self.bridge.alive)

    def unplug(self, *links):
        """Cut the lines, and wait until the bridge has noticed."""
        for link in links or LINKS:
            self.lines[link].unplug()
        self.diagnostics.fresh_of_all(links or LINKS, lambda s, _link: s.level == ERROR
                                      and 'closed' in s.message, 'a closed port')


class AbsentAtStart(PortsTest):
    """No port is there as the bridge starts."""

    KEYS = {'port', 'state', 'frames received', 'frames sent', 'bytes received', 'bytes sent',
            'stale', 'checksum errors', 'framing errors', 'reconnects', 'last frame age [s]'}
    OWN_KEYS = {'bus': {'timeouts', 'round trip p50 [ms]', 'round trip max [ms]'},
                'arduino': {'heartbeats sent', 'heartbeat gap [ms]', 'heartbeat max gap [ms]'},
                'mcu': {'frames lost'}}

    def test_ports_that_come_later_are_opened_then(self):
        self.assertEqual(self.lift(0, 1).status, NOT_SENT)
        for link in LINKS:
            line = self.bridge.wait_for('%s: %s: there is no such device' % (
                link, self.lines[link].near))
            self.assertIn('WARN', line)
        self.assert_statuses(self.diagnostics.wait_for_all(
            LINKS, lambda s, _link: s.level == ERROR and 'no such device' in s.message,
            'no device'))
        self.plug()
        self.assert_flows()
        self.assertEqual(bytes(self.boards['bus'].wire[:5]), SYNC_FRAME)
        found = self.diagnostics.fresh_of_all(LINKS, lambda s, _link: s.level == OK, 'OK',
                                              self.talk)
        self.assert_statuses(found)
        self.assertEqual({s.keys['reconnects'] for s in found.values()}, {'0'})

    def talk(self):
        """Send what keeps the links OK."""
        self.boards['arduino'].say(level_imu())
        self.boards['mcu'].say(ranges())

    def assert_statuses(self, found):
        """Each link has one status with every key and its port as hardware id, once a second."""
        for link, status in found.items():
            self.assertEqual(status.hardware_id, self.lines[link].near)
            self.assertEqual(status.keys['port'], status.hardware_id)
            self.assertEqual((self.KEYS | self.OWN_KEYS[link]) - set(status.keys), set(), link)
            until(lambda name=link: len(self.diagnostics.statuses(name)) >= 3, 'three statuses')
            stamps = [each.stamp for each in self.diagnostics.statuses(link)]
            # Not more often; only the first may have been late.
            self.assertGreater(stamps[-1] - stamps[0], len(stamps) - 2.1, stamps)
        names = [{s.name for s in m.status if s.name.startswith(self.name)}
                 for m in self.diagnostics.messages]
        self.assertEqual(set.union(*names), {f'{self.name}: {link} link' for link in LINKS})


if __name__ == '__main__':
    rospy.init_node('ports_test')
    rostest.rosrun(PACKAGE, 'ports', '__main__')
