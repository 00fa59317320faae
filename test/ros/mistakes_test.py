#!/usr/bin/python3
"""Mistakes beyond a single parameter: each ends the node with one line and status 1. Signals end a
node that hangs. parameter_table_test has more mistakes, without processes."""
import os
import shutil
import signal
import subprocess
import unittest
from multiprocessing.pool import ThreadPool
from pathlib import Path

import rosnode
import rospy
import rostest

from boards import (PACKAGE, PATIENCE, SPEED_0_PACKET, BoardsTest, Bridge, CarBoard, command_topic,
                    own_folder, until)
from serial_communication.msg import SpeedPWMCommand

HANGS = 'open(__file__ + ".begun", "w").close(); import time; time.sleep(1e6)'
# A link of the node, a remapping, and a part of the line that the node logs.
REMAPPED = (
    ('bus', '~lift:=~set_logger_level', '/NODE/set_logger_level is the name of '
     '~set_logger_level and of ~lift'),
    ('arduino', '~speed:=~steering', '/NODE/steering is the name of '),
)


class Mistakes(unittest.TestCase):
    """Each mistake is made in a node of its own."""

    @classmethod
    def setUpClass(cls):
        cls.folder = own_folder()
        for name, text in ('fails', '1 / 0'), ('hangs', HANGS):
            Path(cls.folder, name + '.py').write_text(text + '\n')
        cls.path = os.environ['PYTHONPATH']
        os.environ['PYTHONPATH'] = f'{cls.folder}:{cls.path}'
        config = os.path.join(cls.folder, 'wrong.yaml')
        with open(config, 'w') as file:
            file.write('bus: {baud: 1}\n')
        cls.launch_output = os.path.join(cls.folder, 'output')
        with open(cls.launch_output, 'w') as file:
            cls.launch = subprocess.Popen(
                ['roslaunch', PACKAGE, 'bridge.launch', 'config:=' + config, 'name:=launched'],
                stdout=file, stderr=subprocess.STDOUT)

    @classmethod
    def tearDownClass(cls):
        os.environ['PYTHONPATH'] = cls.path
        if cls.launch.poll() is None:
            cls.launch.send_signal(signal.SIGINT)
            cls.launch.wait(PATIENCE)
        shutil.rmtree(cls.folder)

    def absent(self, name):
        """A port that is absent."""
        return os.path.join(self.folder, 'absent', name)

    def ended(self, name, parameters, arguments=()):
        """Run a node with these parameters until it ends; return its status and output."""
        bridge = Bridge(name, parameters, arguments)
        try:
            return bridge.process.wait(PATIENCE), bridge.output()
        except subprocess.TimeoutExpired:
            return 'it goes on', bridge.output()
        finally:
            bridge.kill()

    def assert_one_line(self, said, status, output):
        """The node logs one line with this text, apart from the usual lines of a start."""
        self.assertEqual(status, 1, output)
        self.assertNotIn('Traceback', output)
        lines = [line for line in output.split('\n') if line.strip()
                 and '[INFO]' not in line and 'waiting for it' not in line]
        self.assertEqual(len(lines), 1, output)
        self.assertIn('[FATAL]', lines[0])
        self.assertIn(said, lines[0])

    def test_what_a_board_of_another_package_raises_ends_the_node_with_a_traceback(self):
        status, output = self.ended('fails', {'boards': ['fails']})
        self.assertEqual(status, 1)
        self.assertIn('Traceback', output)
        self.assertTrue(output.rstrip().endswith('ZeroDivisionError: division by zero'), output)

    def test_names_remapped_to_the_same_name_end_the_node_with_one_line(self):
        with ThreadPool(2) as pool:
            results = pool.starmap(self.ended, [
                (f'remapped_{number}', {f'{link}/port': self.absent(link)}, [argument])
                for number, (link, argument, _) in enumerate(REMAPPED)])
        for number, ((_link, argument, said), result) in enumerate(zip(REMAPPED, results)):
            self.assert_one_line(said.replace('NODE', f'remapped_{number}'), *result)

    def test_a_bridge_with_the_name_of_its_topics_ends_with_one_line(self):
        result = self.ended('mcu', {'arduino/port': self.absent('arduino'),
                                    'mcu/port': self.absent('mcu')})
        self.assert_one_line('/mcu/imu is the name of ~imu and of mcu/imu', *result)


class Ended(BoardsTest):
    """A bridge whose car drives is ended."""

    def drive(self, **options):
        """Start a bridge, and wait until it drives."""
        self.car = self.plug('arduino', CarBoard)
        self.bridge = self.start_bridge(
            parameters={'arduino/port': self.lines['arduino'].near}, **options)
        speed = command_topic('/serial_communication/speed', SpeedPWMCommand)
        self.addCleanup(speed.unregister)
        until(lambda: 400 in self.car.speeds, 'the car drives',
              doing=lambda: speed.publish(value=400), every=0.05)

    def assert_stopped(self):
        self.assertNotIn('Traceback', self.bridge.output())
        until(lambda: self.car.raws[-1:] == [SPEED_0_PACKET], 'SPEED 0 is the last packet')

    def test_rosnode_kill_stops_the_car_and_ends_the_bridge(self):
        self.drive()
        rosnode.kill_nodes(['/' + PACKAGE])
        self.assertEqual(self.bridge.process.wait(PATIENCE), 0)
        self.assert_stopped()


if __name__ == '__main__':
    rospy.init_node('mistakes_test')
    rostest.rosrun(PACKAGE, 'mistakes', '__main__')
