#!/usr/bin/python3
"""The sample of a board of another package, doc/wind_sensor, with every program."""
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

from boards import (ERROR, OK, Output, PACKAGE, PATIENCE, Diagnostics, Line, Topic,
                    again_if_stalled, own_folder, program, until)
from serial_communication.msg import SerialMsg

SAMPLE = Path(__file__).resolve().parents[2] / 'doc' / 'wind_sensor'
GUST = b'$WIMWV,090.0,R,012.5,M,A*2F\r\n'      # checked by hand: the XOR of all between $ and *
TEXT = 'wind from 90 degrees, 12.5 m/s'
PARTS = ['frame']


class Program:
    """A running program."""

    def __init__(self, command, environment):
        self._output = Output()
        self.process = subprocess.Popen([program(command[0]), *command[1:]], env=environment,
                                        stdout=self._output)

    def output(self):
        """Its output so far."""
        return self._output.text()

    def close(self):
        """Kill it, in case the test failed."""
        self.process.kill()
        self.process.wait(PATIENCE)
        self._output.close()


class ExternalBoard(unittest.TestCase):
    """A wind sensor on a tty of the test."""

    @classmethod
    def setUpClass(cls):
        cls.folder = own_folder()
        cls.addClassCleanup(shutil.rmtree, cls.folder, ignore_errors=True)
        cls.line = Line(os.path.join(cls.folder, 'wind')).plug()
        cls.addClassCleanup(cls.line.unplug)
        cls.config = f'{cls.folder}/wind.yaml'
        Path(cls.config).write_text(
            (SAMPLE / 'wind.yaml').read_text().replace('/tmp/wind', cls.line.near))
        cls.environment = dict(os.environ,
                               PYTHONPATH=f'{SAMPLE.parent}:{os.environ["PYTHONPATH"]}')
        # As if the sensor had announced it to a bridge that ran before.
        rospy.set_param('/serial_communication/wind/announced', {'gust': {'type': 32}})
        cls.launch = subprocess.Popen(['roslaunch', PACKAGE, 'bridge.launch',
                                       f'config:={cls.config}'], env=cls.environment)
        cls.addClassCleanup(cls.end_launch)
        until(lambda: any(name == '/wind' for name, _ in rospy.get_published_topics()),
              'the bridge is up', PATIENCE, every=0.1)
        cls.wind, cls.traffic = Topic('/wind', Vector3Stamped), Topic('/serial_msg', SerialMsg)
        cls.diagnostics = Diagnostics()

    @classmethod
    def end_launch(cls):
        """Send Ctrl-C to roslaunch."""
        cls.launch.send_signal(signal.SIGINT)
        cls.launch.wait(PATIENCE)

    def start(self, *command):
        """Start a program of the package, which ends with the test."""
        started = Program(command, self.environment)
        self.addCleanup(started.close)
        return started

    def run_program(self, *command):
        """Run a program; return its exit status and output."""
        started = self.start(*command)
        return started.process.wait(PATIENCE), started.output()

    def say(self, data, line=None):
        with open((line or self.line).far, 'wb', buffering=0) as board:
            board.write(data)

    def test_a_sentence_is_published_and_shown(self):
        gust = self.wind.next(lambda m: True, doing=lambda: self.say(GUST))
        self.assertEqual(gust.header.frame_id, 'wind')
        self.assertAlmostEqual(gust.vector.y, 12.5)
        self.assertAlmostEqual(gust.vector.x, 0.0)
        shown = self.traffic.next(lambda m: True, doing=lambda: self.say(GUST))
        self.assertEqual((shown.link, shown.text, bytes(shown.frame), shown.error),
                         ('wind', 'wind from 90 degrees, 12.5 m/s', GUST, ''))

    def test_its_port_may_vanish_and_return_and_its_parameters_are_as_given(self):
        self.line.unplug()
        self.diagnostics.fresh('wind', lambda s: s.level == ERROR, 'the port has gone')
        self.line.plug()
        self.wind.next(lambda m: True, doing=lambda: self.say(GUST))
        self.assertEqual(rospy.get_param('/serial_communication/wind/port'), self.line.near)
        self.assertFalse(rospy.has_param('/serial_communication/wind/announced'))

    def test_its_simulator_works_like_the_built_in_ones_and_the_monitor_shows_its_link(self):
        self.start('simulator', 'wind_sensor', '--port', self.line.far, '--faults', 'drop=0.1',
                   '--seed', '1')
        self.wind.next(lambda m: abs(hypot(m.vector.x, m.vector.y) - 5) < 1e-6)
        self.diagnostics.fresh('wind', lambda s: s.level == OK, 'the link is OK')

        def shown():        # unless this machine stalls
            status, output = self.run_program('monitor', '--once')
            print(status, output)
            return status == 0 and re.search(r'(?m)^wind +OK ', output) \
                and re.search(r'(?m)^wind +[\d.]+ Hz  vector', output)
        again_if_stalled(shown)

    def test_its_frames_are_explained_by_the_name_of_the_link_and_of_the_package(self):
        status, output = self.run_program('wire', 'explain', 'wind', '--config', self.config,
                                          GUST.hex())
        self.assertEqual(status, 0, output)
        self.assertIn(TEXT, output)
        self.assertEqual(re.findall(r'(?m)^  (?:[0-9a-f]{2} )+ +([a-z]+)', output), PARTS)
        status, output = self.run_program('wire', 'explain', 'wind_sensor', GUST.hex()[:-8])
        self.assertEqual(status, 1)
        self.assertIn('incomplete', output)


if __name__ == '__main__':
    rospy.init_node('external_board_test')
    rostest.rosrun(PACKAGE, 'external_board', '__main__')
