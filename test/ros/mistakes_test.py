#!/usr/bin/python3
"""Mistakes beyond a single parameter: each ends the node with one line and status 1. Signals end a
node that hangs. parameter_table_test has more mistakes, without processes."""
import itertools
import os
import queue
import shutil
import signal
import subprocess
import time
import unittest
from multiprocessing.pool import ThreadPool
from pathlib import Path

import rosgraph
import rosnode
import rospy
import rostest

from boards import (PACKAGE, PATIENCE, SPEED_0_PACKET, BoardsTest, Bridge, CarBoard, Line,
                    command_topic, own_folder, until)
from serial_communication.msg import SpeedPWMCommand
from serial_communication.ros.last_resort import LastResort

ENDS_IN = 2.0        # s from a signal until the node has ended, even if something hangs
DESCRIPTION = """
from serial_communication.boards.description import Description
from serial_communication.boards.mcu.wire import Decoder
DESCRIPTION = Description('wind', __name__, lambda sent, parameters: Decoder())
"""
BOARD = """
import time
from serial_communication.boards.mcu.link import McuLink
from serial_communication.ros.interface import Interface
from serial_communication.ros.parameter import BAUD, PORT, Parameter
from serial_communication.transport.port import Port


class INTERFACE(Interface):
    NAME = 'wind'
    PARAMETERS = {'port': PORT, 'baud': BAUD}

    def __init__(self, parameters, link_options):
        self.link = McuLink(Port(parameters['port']), 1.0, on_status=lambda *_: None,
                            on_silence=lambda *_: None, **link_options._asdict())
"""
HANGS = 'open(__file__ + ".begun", "w").close(); time.sleep(1e6)'
MODULES = {      # by name: the code, and a part of the line that the node logs
    'leaves_a_thread': ('import threading, time\n'
                        'threading.Thread(target=time.sleep, args=(1e6,)).start(); 1 / 0',
                        "importing 'leaves_a_thread' failed: ZeroDivisionError"),
    'exits_as_made': (BOARD + '        raise SystemExit(3)',
                      'the board wind (exits_as_made.ros) cannot start: SystemExit: 3 ('),
    'linkless': (BOARD + '        self.link = 5',
                 'the board wind (linkless.ros) cannot start: TypeError: its link is 5, '
                 'must be a Link'),
    'not_advertised': (BOARD + '    def advertise(self): 1 / 0',
                       'the board wind (not_advertised.ros) cannot start: ZeroDivisionError'),
}
HANGING = {
    'hangs': 'import time\n' + HANGS,
    'ignores_exceptions': 'import time\n' + HANGS.replace(';', '\nwhile True:\n  try:')
                          + '\n  except BaseException: pass',
    'spins': HANGS.replace('time.sleep(1e6)', '\nwhile True: pass'),
    'hangs_as_made': BOARD + '        ' + HANGS,
    'hangs_as_advertised': BOARD + '    def advertise(self): ' + HANGS,
}
# A link of the node, a remapping, and a part of the line that the node logs.
REMAPPED = (
    ('bus', '~lift:=~set_logger_level', '/NODE/set_logger_level cannot be a serial_communication/'
     'Lift: this node already uses the name for a roscpp/SetLoggerLevel'),
    ('bus', '~lift:=serial_msg', '/serial_msg cannot be a serial_communication/Lift: this node '
     'already uses the name for a serial_communication/SerialMsg'),
    ('arduino', '~speed:=~steering', '/NODE/steering cannot be a serial_communication/'
     'SteeringPWMCommand: this node already uses the name for a serial_communication/'
     'SpeedPWMCommand'),
    ('mcu', 'mcu/range_1:=mcu/range_2', '/mcu/range_2 cannot be a sensor_msgs/Range: this node '
     'already uses the name for a sensor_msgs/Range'),
)


class Mistakes(unittest.TestCase):
    """Each mistake is made in a node of its own."""

    @classmethod
    def setUpClass(cls):
        cls.folder = own_folder()
        for name, text in [*((name, each[0]) for name, each in MODULES.items()),
                           *HANGING.items()]:
            path = Path(cls.folder, name + '.py')
            if text.startswith(BOARD):
                path = Path(cls.folder, name, 'ros.py')
                path.parent.mkdir()
                (path.parent / '__init__.py').write_text(DESCRIPTION)
            path.write_text(text + '\n')
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

    def test_a_mistake_in_another_packages_board_ends_the_node_with_one_line(self):
        with ThreadPool(2) as pool:
            results = pool.starmap(self.ended, [
                (name, {'boards': [name], 'wind/port': self.absent(name)}) for name in MODULES])
        for (name, (_text, said)), result in zip(MODULES.items(), results):
            self.assert_one_line(f'parameter /{name}/boards', *result)
            self.assert_one_line(said, *result)

    def end_by_signal(self, name, number):
        """End a node that hangs; return how many s that took, its status and its output."""
        begun = Path(self.folder, name + '.py.begun')
        if HANGING[name].startswith(BOARD):
            begun = Path(self.folder, name, 'ros.py.begun')
        bridge = Bridge(name, {'boards': [name], 'wind/port': self.absent(name)})
        until(begun.exists, f'{name}: it hangs')
        begun.unlink()
        return (*bridge.end(number), bridge.output())

    def test_a_signal_ends_the_node_while_a_boards_code_hangs(self):
        with ThreadPool(2) as pool:
            ends = pool.starmap(self.end_by_signal, zip(HANGING, itertools.cycle(
                (signal.SIGINT, signal.SIGTERM))))
        for name, (seconds, status, output) in zip(HANGING, ends):
            self.assertEqual(status, 0, (name, output))
            self.assertLess(seconds, ENDS_IN, name)
            self.assertNotIn('Traceback', output)

    def test_a_slow_import_is_logged_while_it_lasts(self):
        bridge = Bridge('slow', {'boards': ['hangs'], 'wind/port': self.absent('slow')})
        line = bridge.wait_for('still being imported')
        self.assertIn("parameter /slow/boards: the module 'hangs'", line)
        self.assertTrue(bridge.alive)
        bridge.end()
        os.unlink(os.path.join(self.folder, 'hangs.py.begun'))

    def test_names_remapped_to_the_same_name_end_the_node_with_one_line(self):
        with ThreadPool(2) as pool:
            results = pool.starmap(self.ended, [
                (f'remapped_{number}', {f'{link}/port': self.absent(link)}, [argument])
                for number, (link, argument, _) in enumerate(REMAPPED)])
        for number, ((_link, argument, said), result) in enumerate(zip(REMAPPED, results)):
            self.assert_one_line(said.replace('NODE', f'remapped_{number}'), *result)
            self.assert_one_line(f'; check the remappings {argument}', *result)

    def test_a_bridge_with_the_name_of_its_topics_ends_with_one_line(self):
        result = self.ended('mcu', {'arduino/port': self.absent('arduino'),
                                    'mcu/port': self.absent('mcu')})
        self.assert_one_line('/mcu/imu cannot be a sensor_msgs/Imu: this node already uses the '
                             'name for a sensor_msgs/Imu', *result)
        self.assert_one_line('give the node another name', *result)

    def test_that_name_is_allowed_while_no_two_names_are_the_same(self):
        bridge = Bridge('mcu', {'mcu/port': self.absent('mcu'), 'publish_tf': True})
        bridge.wait_for('waiting for it')
        self.assertTrue(bridge.alive)
        self.assertEqual(bridge.end()[1], 0, bridge.output())

    def test_the_car_is_stopped_if_a_later_board_fails_to_start(self):
        line = Line(os.path.join(self.folder, 'car')).plug()
        self.addCleanup(line.unplug)
        car = CarBoard(line.far)
        self.addCleanup(car.close)
        until(lambda: car.connected, 'the board has its port')
        result = self.ended('late', {'arduino/port': line.near, 'boards': ['not_advertised'],
                                     'wind/port': self.absent('wind')})
        self.assert_one_line('cannot start: ZeroDivisionError', *result)
        until(lambda: car.raws[-1:] in ([], [SPEED_0_PACKET]),
              f'SPEED 0 is the last packet, if any: {car.raws[-3:]}')

    def test_under_roslaunch_the_mistake_is_logged_once_and_ctrl_c_ends_the_node(self):
        def text():
            with open(self.launch_output) as file:
                return file.read()

        until(lambda: 'bus/baud is 1 (int)' in text(), 'it is said')
        # A node that ends would be started again within 12 s; most of these have already passed.
        until(lambda: time.time() > os.path.getmtime(self.launch_output) + 12.0,
              'the time passes', 20.0)
        self.assertEqual(text().count('bus/baud is 1 (int)'), 1, text())
        self.assertNotIn('process has died', text())
        self.assertTrue(rosgraph.Master('/mistakes_test').lookupNode('/launched'))
        self.launch.send_signal(signal.SIGINT)
        self.assertEqual(self.launch.wait(PATIENCE), 0)
        self.assertNotIn('escalating', text())
        self.assertNotIn('Traceback', text())


class Ended(BoardsTest):
    """Two more ways to end a bridge whose car drives; the campaign has the signals."""

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

    def test_sighup_under_nohup_does_not_end_the_bridge(self):
        # This is what nohup does; ignored signals are inherited.
        self.drive(before=('sh', '-c', 'trap "" HUP; exec "$@"', 'nohup'))
        self.bridge.process.send_signal(signal.SIGHUP)
        self.car.forget()
        self.car.wait_for_heartbeats(100)
        self.assertEqual(self.bridge.end(signal.SIGTERM)[1], 0)
        self.assert_stopped()

    def test_rosnode_kill_stops_the_car_and_ends_the_bridge(self):
        self.drive()
        rosnode.kill_nodes(['/' + PACKAGE])
        self.assertEqual(self.bridge.process.wait(PATIENCE), 0)
        self.assert_stopped()


class LastResortTest(unittest.TestCase):
    """The forced end of a process that hangs."""

    def test_it_keeps_the_status_of_what_failed(self):
        ended = queue.SimpleQueue()
        last_resort = LastResort(0.05, ended.put)
        last_resort.begin(1)
        last_resort.begin()     # as rospy does at its shutdown
        self.assertEqual(ended.get(timeout=PATIENCE), 1)


if __name__ == '__main__':
    rospy.init_node('mistakes_test')
    rostest.rosrun(PACKAGE, 'mistakes', '__main__')
