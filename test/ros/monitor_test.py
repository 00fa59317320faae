#!/usr/bin/python3
"""monitor: its output for a bridge that works, that has an error, and that is restarted."""
import os
import signal
import subprocess
import threading

import rosgraph
import rospy
import rostest

from boards import (Output, PATIENCE, BoardsTest, BusBoard, CarBoard, level_imu, program, until)
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus

NAME = 'watched'


class Monitor:
    """A monitor that the test starts and ends."""

    def __init__(self, *arguments, **environment):
        self._output = Output()
        self.process = subprocess.Popen(
            [program('monitor'), *arguments], env={**os.environ, **environment},
            stdout=self._output, stderr=subprocess.STDOUT)

    def output(self):
        """Its output so far."""
        return self._output.text()

    def wait_for(self, words, times=1):
        """Wait until it has printed these words `times` times."""
        until(lambda: self.output().count(words) >= times, f'the monitor says "{words}"',
              every=0.05)

    def status(self):
        """Wait until it ends by itself; return its exit status."""
        return self.process.wait(PATIENCE)

    def end(self):
        """Send Ctrl-C; return its exit status."""
        self.process.send_signal(signal.SIGINT)
        return self.status()

    def close(self):
        """Kill it, in case the test failed."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait(PATIENCE)


class TalkingCar(CarBoard):
    """A car that sends measurements, slower than a real one."""

    def __init__(self, path):
        super().__init__(path)
        self._quiet = threading.Event()
        self._talking = threading.Thread(target=self._talk, daemon=True)
        self._talking.start()

    def close(self):
        self._quiet.set()
        self._talking.join(10)
        super().close()

    def _talk(self):
        while not self._quiet.wait(0.05):
            self.say(level_imu())
            self.say(arduino.Voltage(11.5))


class MonitorTest(BoardsTest):
    """A bridge with a bus board and a car that sends all the time."""

    def setUp(self):
        super().setUp()
        self.board = self.plug('bus', BusBoard, polled=True)
        self.plug('arduino', TalkingCar)

    def bridge(self, master=None):
        """Start a bridge, and wait until it works."""
        self.board.forget()
        bridge = self.start_bridge(NAME, {
            'bus/port': self.lines['bus'].near, 'arduino/port': self.lines['arduino'].near,
            'bus/environment_period': 0.2}, master=master)
        until(lambda: self.board.requests(bus.FUNCTION), 'the bus is polled')
        return bridge

    def monitor(self, *arguments, **environment):
        """Start a monitor of the bridge."""
        monitor = Monitor('--node', NAME, *arguments, **environment)
        self.addCleanup(monitor.close)
        return monitor

    def once(self, *arguments):
        """Status and output of `monitor --once`."""
        monitor = self.monitor('--once', *arguments)
        return monitor.status(), monitor.output()

    def test_once_is_0_if_every_link_is_ok_and_1_if_one_is_not(self):
        self.bridge()
        # Without real-time priority a busy machine delays the heartbeat now and then.
        said = until(self.all_ok, 'every link is OK')
        self.assertRegex(said, r'(?m)^bus +OK +ready, errors 0')
        self.assertRegex(said, r'(?m)^arduino +OK +')
        self.assertNotRegex(said, r'(?m)^mcu')       # it has no port
        self.assertRegex(said, r'(?m)^~voltage +[\d.]+ Hz  11\.50 V$')
        self.assertRegex(said, r'(?m)^~imu +[\d.]+ Hz  roll 0\.0 deg, pitch')
        said = until(lambda: self.all_ok('--report'), 'every link is OK')
        self.assertRegex(said, r'(?m)^ports:\n  ')
        self.assertRegex(said, r'(?m)^  bus  OK  ready\n(    .*\n)*    checksum errors: 0$')
        self.assertIn(f"\n    port: {self.lines['bus'].near}\n", said)
        self.lines['bus'].unplug()
        status, said = self.once()
        self.assertEqual(status, 1, said)
        self.assertRegex(said, r'(?m)^bus +ERROR ')

    def all_ok(self, *arguments):
        """The table if every link is OK."""
        status, said = self.once(*arguments)
        return said if status == 0 else ''

    def test_once_without_a_bridge(self):
        status, said = self.once('--node', '/robot/absent')
        self.assertEqual(status, 1)
        trouble = f'monitor: no bridge /robot/absent at {rosgraph.get_master_uri()}\n'
        self.assertEqual(said, trouble)
        status, said = self.once('--node', '/robot/absent', '--report')
        self.assertEqual(status, 1)
        self.assertRegex(
            said, r'^serial_communication \d+\.\d+\.\d+, rospy \d.*, Python 3.*\n.*Linux ')
        self.assertTrue(said.endswith('\n\n' + trouble), said)


if __name__ == '__main__':
    rospy.init_node('monitor_test')
    rostest.rosrun('serial_communication', 'monitor', '__main__')
