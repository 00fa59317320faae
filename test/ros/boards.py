"""Helpers for the tests of the ROS side: bridges and masters that a test starts, and recorders.

The simulated boards and the lines are in test/helpers.
"""
import os
import shutil
import sys
import tempfile
import unittest
from contextlib import suppress
from pathlib import Path
from typing import Dict, NamedTuple
from xmlrpc.client import ServerProxy

import rosgraph
import roslib.packages
import rospy
from diagnostic_msgs.msg import DiagnosticArray
from rosgraph_msgs.msg import Log
from std_srvs.srv import Trigger

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'helpers'))
from fake_boards import (AIR, BusBoard, CarBoard, SensorBoard, level_imu,  # noqa: E402,F401
                         ranges)
from lines import Line  # noqa: E402,F401
from programs import Output, Process, free_master  # noqa: E402,F401
from waiting import PATIENCE, Waiter, again_if_stalled, until  # noqa: E402,F401

PACKAGE = 'serial_communication'
NODE = '/' + PACKAGE
OK, WARN, ERROR = 0, 1, 2    # levels of diagnostics
NOT_SENT, TIMEOUT = 253, 254     # statuses of a bus service beside a reply's CMD1
SYNC_FRAME = bytes.fromhex('a5000000a5')
SPEED_0_PACKET = bytes.fromhex('0204010100')


# -- what a test starts -------------------------------------------------------------------


def program(name):
    """The path of one of the package's programs."""
    found = roslib.packages.find_node(PACKAGE, name)
    assert found, 'the package has no program %s' % name
    return found[0]


class Bridge(Process):
    """A bridge with a name and parameters.

    Args:
        stdout: where it prints; by default what `output` returns.
        master: URI of its master; the test's by default.
        environment: variables to set.
    """

    def __init__(self, name=PACKAGE, parameters=None, arguments=(), stdout=None, master=None,
                 **environment):
        master = master or rosgraph.get_master_uri()
        server = rosgraph.Master('/' + name, master)
        if server.hasParam('/' + name):
            server.deleteParam('/' + name)
        for key, value in (parameters or {}).items():
            server.setParam('/%s/%s' % (name, key), value)
        super().__init__(program('serial_communication_node'), '__name:=' + name, *arguments,
                         stdout=stdout, ROS_MASTER_URI=master, **environment)


class Master:
    """A ROS master of a test's own, which may end, and start again at its address."""

    def __init__(self):
        self.uri = free_master()
        self.server = rosgraph.Master('/test', self.uri)
        self._process = None

    def start(self):
        """Start it, and wait until it answers; return self."""
        self._process = Process('rosmaster', '--core', '-p', self.uri.rpartition(':')[2])
        until(lambda: self.server.is_online() or not self._process.alive, 'the master answers',
              every=0.1)
        assert self._process.alive, f'the master at {self.uri} has ended'
        return self

    def end(self):
        """End it, if it runs."""
        if self._process:
            self._process.kill()


class BoardsTest(unittest.TestCase):
    """A folder, lines with boards at their far ends, and programs; all end with the test."""

    def setUp(self):
        self.folder = tempfile.mkdtemp(prefix='rostest_')     # short, as names of sockets must be
        self.addCleanup(shutil.rmtree, self.folder, ignore_errors=True)
        self.lines = {}      # by the name of the link

    def plug(self, link, kind, **options):
        """Return a board on a line of its own."""
        self.lines[link] = Line(os.path.join(self.folder, link)).plug()
        self.addCleanup(self.lines[link].unplug)
        board = kind(self.lines[link].far, **options)
        self.addCleanup(board.close)
        return board

    def ports(self):
        """The parameters with the ports of the lines."""
        return {link + '/port': line.near for link, line in self.lines.items()}

    def start(self, kind, *arguments, **options):
        """Start a program of this kind."""
        process = kind(*arguments, **options)
        self.addCleanup(process.kill)
        return process


# -- the ROS side -------------------------------------------------------------------------


def names_of(node=NODE, master=None):
    """The node's topics, subscriptions and services; none if the master does not answer."""
    try:
        state = (master or rosgraph.Master('/test')).getSystemState()
    except (rosgraph.MasterException, OSError):
        return [set(), set(), set()]
    return [{name for name, nodes in entries if node in nodes} for entries in state]


class Topic:
    """Records a topic's messages; with `wait`, waits first until the topic is published."""

    def __init__(self, name, message_class, wait=True):
        self.messages = []
        self.name = name
        self._subscriber = rospy.Subscriber(name, message_class, self._take, queue_size=5000,
                                            tcp_nodelay=True)
        if wait:
            until(lambda: self.publishers and self._is_added(), '%s is published' % name)

    def _is_added(self):
        """Whether a publisher sends to it: rospy's tells the subscriber so before it does."""
        me, topic = rospy.get_name(), self._subscriber.resolved_name
        master = rosgraph.Master(me)
        for node in dict(master.getSystemState()[0]).get(topic, ()):
            with suppress(rosgraph.MasterException, OSError):
                rows = ServerProxy(master.lookupNode(node)).getBusInfo(me)[2]
                if any([row[1], row[2], row[4]] == [me, 'o', topic] for row in rows):
                    return True
        return False

    @property
    def publishers(self):
        """How many publishers it is connected to."""
        return self._subscriber.get_num_connections()

    def _take(self, message):
        self.messages.append(message)

    def forget(self):
        """Clear the record."""
        self.messages = []

    def first(self, condition=lambda message: True, doing=None, what=''):
        """Wait for the first message that meets `condition`; call `doing` again and again."""
        def find():
            return next(([m] for m in list(self.messages) if condition(m)), None)
        return until(find, '%s %s' % (self.name, what or 'carries such a message'), doing=doing,
                     every=0.02)[0]

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

    def wait_for(self, words, level=0, doing=None):
        """Wait for a line of the bridge with these words, at `level` if given, and return it."""
        return self.first(lambda m: m.name == NODE and words in m.msg and level in (0, m.level),
                          doing, f'says "{words}"').msg


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

    def wait_for(self, link, condition, what, doing=None, is_fresh=True):
        """Wait for the first status of `link` that meets `condition`; if fresh, from now on."""
        if is_fresh:
            self.forget()

        def find():
            return [status for status in self.statuses(link) if condition(status)]
        try:
            return until(find, f'{link} has a status with {what}', doing=doing, every=0.02)[0]
        except AssertionError as error:
            raise AssertionError(f'{error}; last: {self.statuses(link)[-1:]}') from None


def service(name, service_class):
    """Wait for a service and return its proxy."""
    rospy.wait_for_service(name, PATIENCE)
    return rospy.ServiceProxy(name, service_class)


def wait_for_launch(node=PACKAGE):
    """Wait until a bridge of a roslaunch is up."""
    rospy.wait_for_service('/%s/calibrate_imu' % node, PATIENCE)


def command_topic(name, message_class):
    """A publisher; waits until the bridge has subscribed."""
    topic = rospy.Publisher(name, message_class, queue_size=100, tcp_nodelay=True)
    until(topic.get_num_connections, 'the bridge subscribes to %s' % name)
    return topic


def until_in_step(node=PACKAGE):
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
