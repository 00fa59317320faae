#!/usr/bin/python3
"""monitor: its output for a bridge that works, that has an error, and that is restarted."""
import os
import re
import shutil
import signal
import socket
import subprocess
import tempfile
import threading

import rosgraph
import rospy
import rostest

from boards import (PATIENCE, BoardsTest, BusBoard, CarBoard, Line, Waiter, level_imu, own_folder,
                    program, settle, until)
from serial_communication.boards.arduino import wire as arduino

NAME = 'watched'


class Monitor:
    """A monitor that the test starts and ends."""

    def __init__(self, *arguments, **environment):
        self._output = tempfile.TemporaryFile('w+')
        self.process = subprocess.Popen(
            [program('monitor'), *arguments], env={**os.environ, **environment},
            stdout=self._output, stderr=subprocess.STDOUT)

    def output(self):
        """Its output so far."""
        self._output.seek(0)
        return self._output.read()

    def wait_for(self, words, times=1):
        """Wait until it has printed these words `times` times."""
        until(lambda: self.output().count(words) >= times, f'the monitor says "{words}"',
              seconds=3 * PATIENCE, every=0.05)

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
            self.process.wait(10)


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

    def bridge(self):
        """Start a bridge, and wait until it works."""
        bridge = self.start_bridge(NAME, {
            'bus/port': self.lines['bus'].near, 'arduino/port': self.lines['arduino'].near,
            'bus/environment_period': 0.2})
        settle(NAME, self.board)
        return bridge

    def monitor(self, *arguments, **environment):
        """Start a monitor of the bridge."""
        monitor = Monitor('--node', NAME, *arguments, **environment)
        self.addCleanup(monitor.close)
        return monitor

    def once(self, *arguments):
        """Status and output of `monitor --once`, at a time when no heartbeat was late."""
        looks = []

        def look():
            monitor = self.monitor('--once', *arguments)
            looks[:] = [monitor.status(), monitor.output()]
            return 'heartbeat gap of' not in looks[1]
        until(look, 'a look without a heartbeat gap', seconds=3 * PATIENCE)
        return looks

    def test_once_is_0_if_every_link_is_ok_and_1_if_one_is_not(self):
        self.bridge()
        # Without real-time priority a busy machine delays the heartbeat now and then.
        until(lambda: self.once()[0] == 0, 'every link is OK')
        _, said = self.once()
        self.assertRegex(said, r'(?m)^bus +OK +ready, errors 0')
        self.assertRegex(said, r'(?m)^arduino +(OK|WARN) +')
        self.assertNotRegex(said, r'(?m)^mcu')       # it has no port
        self.assertRegex(said, r'(?m)^~voltage +[\d.]+ Hz  11\.50 V$')
        self.assertRegex(said, r'(?m)^~imu +[\d.]+ Hz  rpy 0\.0 0\.0 0\.0 deg')
        self.lines['bus'].unplug()
        status, said = self.once()
        self.assertEqual(status, 1, said)
        self.assertRegex(said, r'(?m)^bus +ERROR ')

    def test_once_without_a_bridge(self):
        status, said = self.once('--node', '/robot/absent')
        self.assertEqual(status, 1)
        self.assertEqual(said, f'monitor: no bridge /robot/absent at {rosgraph.get_master_uri()}\n')

    def test_a_restart_of_the_bridge_is_shown(self):
        monitor = self.monitor()
        monitor.wait_for(f'/{NAME}')
        bridge = self.bridge()
        monitor.wait_for('the bridge is there')
        monitor.wait_for(' OK ')
        bridge.end(signal.SIGKILL)
        monitor.wait_for(f'the bridge /{NAME} has reported nothing for')
        monitor.wait_for('STALE reported')
        bridge = self.bridge()
        monitor.wait_for('the bridge is back, after')
        gone = monitor.output().count('has reported nothing for')
        bridge.end(signal.SIGKILL)
        monitor.wait_for('has reported nothing for', times=gone + 1)
        # Its last table shows the age of each value.
        self.assertEqual(monitor.end(), 0)
        said = monitor.output()
        table = said[said.rindex('topic '):]
        for topic in 'serial_msg', '~imu', '~environment', '/diagnostics':
            self.assertRegex(table, rf'(?m)^{topic} +\d[\d.]* s old  ')
        self.assertNotIn('Traceback', said)

    def test_a_restart_of_the_master_is_shown(self):
        MASTER_RESTARTED.result(6 * PATIENCE)


def restart_master():
    """Run a monitor and a bridge with a car under a separate master, and restart that master.

    The monitor mostly waits, so this runs in a thread beside the other tests.
    """
    with socket.socket() as free:
        free.bind(('localhost', 0))
        port = free.getsockname()[1]
    uri = f'http://localhost:{port}'
    environment = {'ROS_MASTER_URI': uri}
    folder, processes = own_folder(), []
    line = Line(os.path.join(folder, 'car')).plug()
    talkative = TalkingCar(line.far)

    def start(*command):
        processes.append(subprocess.Popen(
            command, env={**os.environ, **environment}, stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL))
        return processes[-1]

    def master_and_bridge():
        master = start('rosmaster', '--core', '-p', str(port))
        until(rosgraph.Master('/test', uri).is_online, 'the master is there')
        return master, start(program('serial_communication_node'), '__name:=' + NAME,
                             '_arduino/port:=' + line.near)
    monitor = Monitor('--node', NAME, **environment)
    try:
        monitor.wait_for(f'waiting for the ROS master at {uri}')
        master, bridge = master_and_bridge()
        monitor.wait_for('the bridge is there')
        bridge.terminate()
        bridge.wait(PATIENCE)
        master.terminate()
        master.wait(PATIENCE)
        monitor.wait_for(f'no answer from the ROS master at {uri} for')
        master_and_bridge()
        monitor.wait_for('the bridge is back, after')
        monitor.wait_for('topics carry data, ~imu', times=len(re.findall(
            'topics carry data, ~imu', monitor.output())) + 1)
        assert monitor.end() == 0
        assert 'Traceback' not in monitor.output()
    finally:
        monitor.close()
        for process in processes:
            if process.poll() is None:
                process.kill()
                process.wait(10)
        talkative.close()
        line.unplug()
        shutil.rmtree(folder)


if __name__ == '__main__':
    rospy.init_node('monitor_test')
    MASTER_RESTARTED = Waiter(restart_master)
    rostest.rosrun('serial_communication', 'monitor', MonitorTest)
