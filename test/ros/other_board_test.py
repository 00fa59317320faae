#!/usr/bin/python3
"""A board of another package, as doc/developing.md has it: built from the page, and run."""
import os
import re
import shutil
import signal
import subprocess
import unittest
from math import hypot
from pathlib import Path

import rospy
import rostest
from geometry_msgs.msg import Vector3Stamped

from boards import (ERROR, OK, PACKAGE, PATIENCE, Diagnostics, Line, Topic, own_folder, program,
                    until)
from serial_communication.msg import SerialMsg

PAGE = Path(__file__).resolve().parents[2] / 'doc' / 'developing.md'
_FILE = re.compile(r'<!-- file: (\S+) -->\n```\w+\n(.*?)^```$', re.MULTILINE | re.DOTALL)
GUST = b'$WIMWV,090.0,R,012.5,M,A*2F\r\n'      # checked by hand: the XOR of all between $ and *


class OtherBoard(unittest.TestCase):
    """A wind sensor on a tty of the test's own."""

    @classmethod
    def setUpClass(cls):
        cls.folder = own_folder()
        cls.line = Line(os.path.join(cls.folder, 'wind')).plug()
        for name, text in _FILE.findall(PAGE.read_text()):
            path = Path(cls.folder, name)
            path.parent.mkdir(exist_ok=True)
            path.write_text(text.replace('/tmp/wind', cls.line.near))
        Path(cls.folder, 'wind_sensor', '__init__.py').touch()
        environment = dict(os.environ, PYTHONPATH=f'{cls.folder}:{os.environ["PYTHONPATH"]}')
        cls.launch = subprocess.Popen(
            ['roslaunch', PACKAGE, 'bridge.launch', f'config:={cls.folder}/wind.yaml'],
            env=environment)
        cls.simulator = None
        cls.environment = environment
        cls.wind, cls.traffic = Topic('/wind', Vector3Stamped), Topic('/serial_msg', SerialMsg)
        cls.diagnostics = Diagnostics()

    @classmethod
    def tearDownClass(cls):
        for process in (cls.simulator, cls.launch):
            if process:
                process.send_signal(signal.SIGINT)
                process.wait(PATIENCE)
        cls.line.unplug()
        shutil.rmtree(cls.folder, ignore_errors=True)

    def say(self, data):
        with open(self.line.far, 'wb', buffering=0) as board:
            board.write(data)

    def test_a_sentence_is_published_and_shown(self):
        gust = self.wind.next(lambda m: True, doing=lambda: self.say(GUST))
        self.assertEqual(gust.header.frame_id, 'wind')
        self.assertAlmostEqual(gust.vector.y, 12.5)
        self.assertAlmostEqual(gust.vector.x, 0.0)
        shown = self.traffic.next(lambda m: True, doing=lambda: self.say(GUST))
        self.assertEqual((shown.link, shown.text, bytes(shown.frame), shown.error),
                         ('wind', 'wind from 90 degrees, 12.5 m/s', GUST, ''))

    def test_damage_is_counted_and_costs_no_valid_sentence(self):
        def errors(status):
            return int(status.keys['checksum errors'])

        before = errors(self.diagnostics.fresh('wind', lambda s: True, 'any status'))
        self.wind.forget()
        self.say(b'$WIMWV,0' + GUST + GUST.replace(b'0', b'1', 1) + GUST)
        until(lambda: len(self.wind.messages) == 2, 'both valid sentences')
        self.diagnostics.fresh('wind', lambda s: errors(s) == before + 1, 'one more')

    def test_its_port_comes_and_goes_and_its_parameters_are_checked(self):
        self.line.unplug()
        self.diagnostics.fresh('wind', lambda s: s.level == ERROR, 'the port has gone')
        self.line.plug()
        self.wind.next(lambda m: True, doing=lambda: self.say(GUST))
        self.assertEqual(rospy.get_param('/serial_communication/wind/port'), self.line.near)

    def test_its_simulator_is_one_as_ours(self):
        type(self).simulator = subprocess.Popen(
            [program('simulator'), 'wind_sensor.simulator', '--port', self.line.far,
             '--fault', 'flip=0.1', '--seed', '1'], env=self.environment,
            stdout=subprocess.DEVNULL)
        steady = self.wind.next(lambda m: abs(hypot(m.vector.x, m.vector.y) - 5) < 1e-6)
        self.assertTrue(steady)
        self.diagnostics.fresh('wind', lambda s: s.level == OK, 'the link is OK')


if __name__ == '__main__':
    rospy.init_node('other_board_test')
    rostest.rosrun(PACKAGE, 'other_board', '__main__')
