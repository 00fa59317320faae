"""Helpers for the tests of the ROS side: bridges that a test starts and ends, and recorders.

The fake boards, with which tests check exact bytes, and the lines are in test/helpers.
"""
import atexit
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import unittest
from typing import Dict, NamedTuple

import rosgraph
import roslib.packages
import rospy
from diagnostic_msgs.msg import DiagnosticArray
from rosgraph_msgs.msg import Log
from std_srvs.srv import Empty, Trigger

sys.path.insert(0, os.path.join(os.path.dirname(os.path.dirname(os.path.abspath(__file__))),
                                'helpers'))
from fake_boards import (BusBoard, CarBoard, SensorBoard, level_imu, ranges)  # noqa: E402,F401
from fake_bus import AIR  # noqa: E402,F401
from lines import Line  # noqa: E402,F401
from programs import Output, free_master  # noqa: E402
from waiting import PATIENCE, Waiter, again_if_stalled, until  # noqa: E402,F401

PACKAGE = 'serial_communication'
OK, WARN, ERROR = 0, 1, 2    # levels of diagnostics
RX = 0                   # a direction of SerialMsg
NOT_SENT, TIMEOUT = 253, 254     # statuses of a bus service beside a reply's CMD1

SYNC_FRAME = bytes.fromhex('a5000000a5')
SPEED_0_PACKET = bytes.fromhex('0204010100')
CALIBRATION_PACKET = bytes.fromhex('020c00')


# -- bridges that a test starts -----------------------------------------------------------


def program(name):
    """The path of one of the package's programs."""
    found = roslib.packages.find_node(PACKAGE, name)
    assert found, 'the package has no program %s' % name
    return found[0]


def own_folder():
    """A new folder for ports; its path is short, since socket names are limited."""
    return tempfile.mkdtemp(prefix='rostest_')


def plug(*ports):
    """Connect the ports of the bridges in a .test file with those of the boards, until the end."""
    for port in ports:
        atexit.register(Line(port).plug().unplug)


class Bridge:
    """A bridge process with a name and parameters.

    Args:
        stdout: where it prints; a temporary file by default.
        before: arguments before the program on its command line.
        master: URI of its master; the test's by default.
    """

    def __init__(self, name=PACKAGE, parameters=None, arguments=(), stdout=None, before=(),
                 master=None):
        server = rosgraph.Master('/' + name, master)
        if server.hasParam('/' + name):
            server.deleteParam('/' + name)
        for key, value in (parameters or {}).items():
            server.setParam('/%s/%s' % (name, key), value)
        self.name = name
        self._output = Output()
        self.process = subprocess.Popen(
            list(before) + [program('serial_communication_node'), '__name:=' + name]
            + list(arguments), stdout=self._output if stdout is None else stdout,
            stderr=subprocess.STDOUT,
            env=dict(os.environ, ROS_MASTER_URI=master or rosgraph.get_master_uri()))

    def output(self):
        """Its output so far, without colours."""
        return re.sub('\033\\[[0-9;]*m', '', self._output.text())

    def wait_for(self, words):
        """Wait for a line of its output with `words`, and return the first one.

        Use this for lines of the start, which a subscriber of /rosout would miss.
        """
        def find():
            return [line for line in self.output().split('\n') if words in line]
        return until(find, '%s prints "%s"' % (self.name, words), every=0.05)[0]

    @property
    def alive(self):
        """Whether its process runs."""
        return self.process.poll() is None

    def kill(self):
        """Kill it, if it runs."""
        self.process.kill()
        self.process.wait(PATIENCE)

    def end(self, number=signal.SIGINT):
        """Send a signal; return the seconds until the process has ended, and its status."""
        began = time.monotonic()
        if self.alive:
            self.process.send_signal(number)
        try:
            status = self.process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait(PATIENCE)
            raise AssertionError('still runs %g s after signal %d' % (PATIENCE, number))
        return time.monotonic() - began, status


class Master:
    """A ROS master of a test's own, which may end, and start again at its address."""

    def __init__(self):
        self.uri = free_master()
        self.server = rosgraph.Master('/test', self.uri)
        self._process = None

    def start(self):
        """Start it, and wait until it answers; return self."""
        self._process = subprocess.Popen(
            ['rosmaster', '--core', '-p', self.uri.rpartition(':')[2]],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        until(lambda: self.server.is_online() or self._process.poll() is not None,
              'the master answers', every=0.1)
        assert self._process.poll() is None, f'the master at {self.uri} has ended'
        return self

    def end(self):
        """End it, if it runs."""
        if self._process:
            self._process.kill()
            self._process.wait(PATIENCE)


class BoardsTest(unittest.TestCase):
    """A folder, lines with boards at their far ends, and bridges; all end with the test."""

    def setUp(self):
        self.folder = own_folder()
        self.addCleanup(shutil.rmtree, self.folder, ignore_errors=True)
        self.lines = {}      # by the name of the link

    def plug(self, link, kind, **manners):
        """Return a board on a line of its own."""
        self.lines[link] = Line(os.path.join(self.folder, link)).plug()
        self.addCleanup(self.lines[link].unplug)
        board = kind(self.lines[link].far, **manners)
        self.addCleanup(board.close)
        return board

    def start_bridge(self, *arguments, **options):
        """Return a new `Bridge`."""
        bridge = Bridge(*arguments, **options)
        self.addCleanup(bridge.kill)
        return bridge

    def start_master(self):
        """Return a new `Master` that runs."""
        master = Master()
        self.addCleanup(master.end)
        return master.start()


# -- the ROS side -------------------------------------------------------------------------


class Topic:
    """Records a topic's messages; with `wait`, waits first until the topic is published."""

    def __init__(self, name, message_class, wait=True):
        self.messages = []
        self.arrivals = []     # when each was received, by time.monotonic()
        self.name = name
        self._subscriber = rospy.Subscriber(name, message_class, self._take, queue_size=5000,
                                            tcp_nodelay=True)
        if wait:
            until(lambda: self.publishers, '%s is published' % name)

    @property
    def publishers(self):
        """How many publishers it is connected to."""
        return self._subscriber.get_num_connections()

    def _take(self, message):
        self.arrivals.append(time.monotonic())
        self.messages.append(message)

    def forget(self):
        """Clear the record."""
        self.messages, self.arrivals = [], []

    def first(self, condition=lambda message: True, doing=None, what='', seconds=PATIENCE):
        """Wait for the first message that meets `condition`; call `doing` again and again."""
        def find():
            return next(([m] for m in list(self.messages) if condition(m)), None)
        return until(find, '%s %s' % (self.name, what or 'carries such a message'), seconds,
                     doing, every=0.02)[0]

    def next(self, condition=lambda message: True, **arguments):
        """Wait for the first such message from now on."""
        self.forget()
        return self.first(condition, **arguments)

    def close(self):
        """Unsubscribe."""
        self._subscriber.unregister()


class Rosout(Topic):
    """Records the log lines of all nodes."""

    def __init__(self):
        super().__init__('/rosout', Log, wait=False)

    def lines(self, node, words, level=0):
        """The lines of `node` so far with `words` in them, at `level` if given."""
        return [m.msg for m in list(self.messages)
                if m.name == '/' + node and words in m.msg and level in (0, m.level)]

    def wait_for(self, node, words, level=0, doing=None):
        """Wait for such a line and return the first one."""
        return until(lambda: self.lines(node, words, level), '%s says "%s"' % (node, words),
                     doing=doing, every=0.05)[0]


def stamped(stamp, since):
    """Whether a stamp lies between `since` and now, in rospy's time."""
    return since <= stamp <= rospy.Time.now()


class Status(NamedTuple):
    """A status of one link on /diagnostics."""

    level: int
    message: str
    hardware_id: str
    keys: Dict[str, str]
    stamp: float     # s, by the bridge's clock


class Diagnostics(Topic):
    """Records the statuses of one node."""

    def __init__(self, node=PACKAGE):
        self._node = node
        super().__init__('/diagnostics', DiagnosticArray, wait=False)

    def statuses(self, link):
        """The statuses of one link so far, without the one that says that the node starts."""
        return [Status(ord(s.level) if isinstance(s.level, bytes) else s.level, s.message,
                       s.hardware_id, {value.key: value.value for value in s.values},
                       message.header.stamp.to_sec())
                for message in list(self.messages) for s in message.status
                if s.name == '%s: %s link' % (self._node, link) and s.values]

    def wait_for(self, link, condition, what, doing=None):
        """Wait for the first status of `link` that meets `condition`."""
        return self.wait_for_all((link,), lambda status, _link: condition(status), what,
                                 doing)[link]

    def fresh(self, link, condition, what, doing=None):
        """The same, from now on."""
        self.forget()
        return self.wait_for(link, condition, what, doing)

    def wait_for_all(self, links, condition, what, doing=None):
        """Wait for the first status of each link for which `condition(status, link)` is true."""
        found = {}

        def complete():
            for link in links:
                if link not in found:
                    met = [s for s in self.statuses(link) if condition(s, link)]
                    found.update({link: s for s in met[:1]})
            return len(found) == len(links)
        try:
            until(complete, 'a status with ' + what, doing=doing, every=0.02)
        except AssertionError as error:
            raise AssertionError('%s; last: %s' % (error, {
                link: self.statuses(link)[-1:] for link in links if link not in found})) from None
        return found

    def fresh_of_all(self, links, condition, what, doing=None):
        """The same, from now on."""
        self.forget()
        return self.wait_for_all(links, condition, what, doing)


def service(name, service_class):
    """Wait for a service and return its proxy."""
    rospy.wait_for_service(name, PATIENCE)
    return rospy.ServiceProxy(name, service_class)


def wait_for_launch(node=PACKAGE):
    """Wait until a bridge of a roslaunch is up.

    roslaunch, what it starts before, and the bridge start one after the other. So the patience with
    one program is not enough on a busy machine.
    """
    rospy.wait_for_service('/%s/calibrate_imu' % node, PATIENCE)


def command_topic(name, message_class):
    """A publisher; waits until the bridge has subscribed."""
    topic = rospy.Publisher(name, message_class, queue_size=100, tcp_nodelay=True)
    until(topic.get_num_connections, 'the bridge subscribes to %s' % name)
    return topic


def calibrates(node=PACKAGE):
    """Whether the service succeeds; it is refused after a stall of this machine."""
    try:
        service('/%s/calibrate_imu' % node, Empty)()
    except rospy.ServiceException:
        return False
    return True


def until_in_step(node):
    """Wait until the bus of `node` answers ECHO: no stall before that keeps a call back."""
    echo = service('/%s/bus/echo' % node, Trigger)
    until(lambda: echo().success, 'the bus answers ECHO')


def settle(node, board):
    """Wait until the bus of `node` is in step and idle; clear the records of `board`."""
    board.script.clear()
    board.rule = lambda request: None
    until(lambda: board.connected, 'the board has its port')
    until_in_step(node)
    board.forget()


def values_of(message, *names):
    """The fields with these names, as a tuple."""
    return tuple(getattr(message, name) for name in names)
