#!/usr/bin/python3
"""Two swapped ports: the bridge says so, `ports` finds the boards, and with the configuration that
it writes all boards talk."""
import os
import subprocess
import threading

import rospy
import rostest

from boards import (PACKAGE, WARN, BoardsTest, Bridge, BusBoard, CarBoard, Diagnostics, Rosout,
                    SensorBoard, program, ranges)
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.config_file import read_parameters

LINKS = 'bus', 'arduino', 'mcu'
WORDS = "bytes come, but they are the {}'s: are the two ports swapped?"


def talks(status):
    """Whether the link's own board talks; on a busy machine the level may still be a warning."""
    return int(status.keys['frames received']) > 3 and 'bytes come' not in status.message


class WrongPortTest(BoardsTest):
    """Three boards that send all the time."""

    def setUp(self):
        super().setUp()
        self.boards = [self.plug(link, kind) for link, kind in zip(
            LINKS, (BusBoard, CarBoard, SensorBoard))]
        ending = threading.Event()
        sending = threading.Thread(target=self.send, args=(ending,), name='boards')
        sending.start()
        self.addCleanup(sending.join)
        self.addCleanup(ending.set)

    def send(self, ending):
        """Send what the boards send by themselves."""
        while not ending.wait(0.02):
            self.boards[1].say(arduino.Ticks(3))
            self.boards[1].say(arduino.SteeringAngle(500))
            self.boards[2].say(ranges())

    def bridge(self, name, parameters):
        """Start a bridge."""
        bridge = Bridge(name, parameters)
        self.addCleanup(bridge.end)
        diagnostics = Diagnostics(name)
        self.addCleanup(diagnostics.close)
        return bridge, diagnostics

    def test_swapped_ports_are_reported_and_mended(self):
        log = Rosout()
        self.addCleanup(log.close)
        swapped, diagnostics = self.bridge('swapped', {
            'bus/port': self.lines['bus'].near, 'arduino/port': self.lines['mcu'].near,
            'mcu/port': self.lines['arduino'].near})
        for link, other in ('arduino', 'mcu'), ('mcu', 'arduino'):
            status = diagnostics.wait_for(
                link, lambda s, other=other: WORDS.format(other) in s.message, 'is swapped')
            self.assertEqual(status.level, WARN)
            log.wait_for('swapped', f'{link}: {WORDS.format(other)} `rosrun serial_communication '
                         'ports`')
        diagnostics.wait_for('bus', talks, 'is not')
        # While the bridge has the ports, they are left alone, and the bridge is named.
        near = [line.near for line in self.lines.values()]
        done = self.ports(*near)
        self.assertEqual(done.stdout.count(f'(pid {swapped.process.pid})'), 3, done.stdout)
        swapped.end()
        path = os.path.join(self.folder, 'robot.yaml')
        done = self.ports('--ask', '--write', path, *near)
        self.assertEqual(done.returncode, 0, done.stdout)
        written = read_parameters(path)
        self.assertEqual({link: written[link]['port'] for link in LINKS},
                         {link: self.lines[link].near for link in LINKS})
        _bridge, diagnostics = self.bridge('mended', written)
        for link in LINKS:
            diagnostics.wait_for(link, talks, 'talks')

    def ports(self, *arguments):
        """Run `ports`."""
        return subprocess.run([program('ports'), *arguments], stdout=subprocess.PIPE,
                              stderr=subprocess.STDOUT, encoding='utf-8')


if __name__ == '__main__':
    rospy.init_node('wrong_port_test')
    rostest.rosrun(PACKAGE, 'wrong_port', '__main__')
