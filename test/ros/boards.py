"""Helpers for the tests of the ROS side.

They have fake boards, so that tests can check exact bytes; lines and bridges that a test starts and
ends; and functions that wait for a condition, with a deadline, instead of a fixed time.
"""
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
import xmlrpc.client
from typing import Dict, NamedTuple

import rosgraph
import roslib.packages
import rospy
import serial
from diagnostic_msgs.msg import DiagnosticArray
from rosgraph_msgs.msg import Log
from std_srvs.srv import Trigger

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.bus import wire as bus

sys.path.insert(0, os.path.join(os.path.dirname(os.path.dirname(os.path.abspath(__file__))),
                                'helpers'))
from fake_bus import AIR, FakeBus  # noqa: E402,F401
from heartbeats import longest_gap  # noqa: E402
from waiting import PATIENCE, Waiter, until  # noqa: E402,F401
from witness import Witness  # noqa: E402

PACKAGE = 'serial_communication'
OK, WARN, ERROR = 0, 1, 2        # levels of diagnostics
RX, TX = 0, 1                    # directions of SerialMsg
NOT_SENT, TIMEOUT = 253, 254     # statuses of a bus service beside a reply's CMD1
GIVE_UP = 0.3                    # s after which a board drops an incomplete frame
_QUIET = 0.4                     # s after which a car that has talked sends an empty packet

SYNC_FRAME = bytes.fromhex('a5000000a5')
HEARTBEAT_PACKET = bytes.fromhex('020b00')
SPEED_0_PACKET = bytes.fromhex('0204010100')
CALIBRATION_PACKET = bytes.fromhex('020c00')


# -- boards -----------------------------------------------------------------------------


class Board:
    """A board at the far end of a line; it opens the port again when the port returns."""

    def __init__(self, path, decoder):
        self.wire = bytearray()      # all bytes since `forget`
        self.frames = []             # the valid ones; stamped with time.monotonic()
        self.bad = []                # the invalid ones
        self._path = path
        self._decoder = decoder
        self._port = None
        self._last_byte = 0.0
        self._writing = threading.Lock()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=path, daemon=True)
        self._thread.start()

    @property
    def connected(self):
        """Whether the far end is open."""
        return self._port is not None

    @property
    def raws(self):
        """The bytes of the valid frames."""
        return [frame.raw for frame in self.frames]

    def forget(self):
        """Clear the records."""
        self.wire, self.frames, self.bad = bytearray(), [], []

    def unread(self):
        """How many bytes are not read yet; `take` may call this."""
        return self._port.in_waiting

    def write(self, data):
        """Write bytes; False if the port is closed."""
        with self._writing:
            try:
                self._port.write(data)
                return True
            except (OSError, AttributeError, TypeError):
                return False

    def close(self):
        """Close the port and end the thread."""
        self._closing.set()
        self._thread.join(5)

    def take(self, frame):
        """Handle a valid frame; subclasses override this."""

    def _run(self):
        while not self._closing.is_set():
            try:
                # Exclusive, since another program may still use a link to a device that is now
                # another line's, and must not read this line's bytes.
                self._port = serial.Serial(self._path, 115200, timeout=0.05, exclusive=True)
            except (OSError, ValueError):
                self._closing.wait(0.02)
                continue
            port = self._port
            self._decoder.reset()
            try:
                while not self._closing.is_set():
                    self._read(port)
            except (OSError, TypeError):
                pass        # the line was cut
            self._port = None
            try:
                port.close()
            except OSError:
                pass

    def _read(self, port):
        data = port.read(max(1, port.in_waiting))
        now = time.monotonic()
        frames = []
        if data:
            self._last_byte = now
            self.wire.extend(data)
            frames = self._decoder.feed(data, now)
        elif now > self._last_byte + GIVE_UP:
            frames = self._decoder.give_up()
        for frame in frames:
            if frame.cause:
                self.bad.append(frame)
            else:
                self.frames.append(frame)
                self.take(frame)


class BusBoard(FakeBus, Board):
    """The main control board."""

    def __init__(self, path, **manners):
        FakeBus.__init__(self, **manners)
        Board.__init__(self, path, bus.RequestDecoder())

    @property
    def others(self):
        """The frames that are neither SYNC nor ECHO."""
        return [frame.raw for frame in self.frames if frame.type not in (bus.SYNC, bus.ECHO)]


class CarBoard(Board):
    """The model car, which does not move at first.

    Once it has sent something it is never silent, as long as it gets heartbeats: the bridge refuses
    commands to a board that has fallen silent. Then it sends empty packets, which are nothing.
    """

    def __init__(self, path):
        self.command_frames = []     # neither heartbeats nor repetitions of SPEED 0
        self._speed = 0
        self._wrote_at = float('inf')
        super().__init__(path, arduino.BoardDecoder())

    @property
    def heartbeats(self):
        """When each was received, by time.monotonic()."""
        return [frame.stamp for frame in self.frames if frame.raw == HEARTBEAT_PACKET]

    @property
    def commands(self):
        """The packets that are neither heartbeats nor repetitions of SPEED 0."""
        return [frame.raw for frame in self.command_frames]

    @property
    def speeds(self):
        """The values of the speed commands among them."""
        return [frame.message.value for frame in self.command_frames
                if isinstance(frame.message, arduino.SpeedCommand)]

    def forget(self):
        super().forget()
        self.command_frames = []

    def take(self, frame):
        if isinstance(frame.message, arduino.SpeedCommand):
            before, self._speed = self._speed, frame.message.value
            if before == self._speed == 0:
                return
        if frame.raw != HEARTBEAT_PACKET:
            self.command_frames.append(frame)
        elif time.monotonic() > self._wrote_at + _QUIET:
            self.write(b'\0')

    def write(self, data):
        self._wrote_at = time.monotonic()
        return super().write(data)

    def say(self, message):
        """Send a typed message."""
        self.write(arduino.encode(message))

    def wait_for_heartbeats(self, number):
        """Wait for that many heartbeats from now on."""
        wanted = len(self.heartbeats) + number
        until(lambda: len(self.heartbeats) >= wanted, '%d heartbeats' % number)

    def longest_gap(self, rate=100.0):
        """The longest time between two heartbeats, in s, at least, as the bridge sent them."""
        return longest_gap(self.heartbeats, rate)

    def wait_for_heartbeat_rate(self, least, most, number=100):
        """Wait until the rate of `number` heartbeats is between these limits, in Hz.

        A stall of this machine lowers only the rate of the heartbeats that it delays.
        """
        def measured():
            self.forget()
            self.wait_for_heartbeats(number)
            stamps = self.heartbeats
            return least < (len(stamps) - 1) / (stamps[-1] - stamps[0]) < most
        until(measured, 'heartbeats at %g to %g Hz' % (least, most))


class SensorBoard(Board):
    """The board with the range sensors. Nothing is sent to it: `wire` must stay empty."""

    def __init__(self, path):
        self.seq = 0
        super().__init__(path, mcu.Decoder())

    def say(self, message):
        """Send a typed message as the next frame."""
        self.write(mcu.encode(message, self.seq))
        self.seq = (self.seq + 1) % 256


def level_imu():
    """A plausible IMU packet, level and at rest."""
    return arduino.Imu(16384, 0, 0, 0, 0, 0, 0, 0, 0, 8192, 0)


def ranges(first=470, second=580, yaw=0.0, pitch=0.0, roll=0.0):
    """A sensor status."""
    return mcu.SensorStatus(first, second, yaw, pitch, roll)


# -- lines and bridges that a test starts -------------------------------------------------


def program(name):
    """The path of one of the package's programs."""
    found = roslib.packages.find_node(PACKAGE, name)
    assert found, 'the package has no program %s' % name
    return found[0]


def own_folder():
    """A new folder for ports; its path is short, since socket names are limited."""
    return tempfile.mkdtemp(prefix='rostest_')


class Line:
    """A socat pair that can be unplugged and plugged in again."""

    def __init__(self, near):
        self.near = near
        self.far = near + '_board'
        self._process = None

    def plug(self):
        """Connect both ends."""
        self._process = subprocess.Popen([program('socat_pair'), self.near, self.far],
                                         stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        until(lambda: os.path.exists(self.near) and os.path.exists(self.far),
              'socat makes %s' % self.near)
        return self

    def unplug(self):
        """Disconnect both ends; both ports have vanished when this returns."""
        if self._process is None:
            return
        # The links first, so that they never point to a device that another program has got.
        for path in (self.near, self.far):
            if os.path.lexists(path):
                os.unlink(path)
        self._process.kill()
        self._process.wait(10)
        self._process = None


def pid_of(node):
    """The process id of a running node."""
    with xmlrpc.client.ServerProxy(rosgraph.Master('/test').lookupNode('/' + node)) as proxy:
        return proxy.getPid('/test')[2]


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
        self._output = tempfile.TemporaryFile('w+')
        self.process = subprocess.Popen(
            list(before) + [program('serial_communication_node'), '__name:=' + name]
            + list(arguments), stdout=self._output if stdout is None else stdout,
            stderr=subprocess.STDOUT,
            env=dict(os.environ, ROS_MASTER_URI=master or rosgraph.get_master_uri()))

    def output(self):
        """Its output so far, without colours."""
        self._output.seek(0)
        return re.sub('\033\\[[0-9;]*m', '', self._output.read())

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

    def end(self, number=signal.SIGINT):
        """Send a signal; return the seconds until the process has ended, and its status.

        They are those of a machine that has time: see witness.py.
        """
        with Witness() as witness:
            began = time.monotonic()
            if self.alive:
                self.process.send_signal(number)
            try:
                status = self.process.wait(PATIENCE)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait(10)
                raise AssertionError('still runs %g s after signal %d' % (PATIENCE, number))
            seconds = time.monotonic() - began
        return seconds / witness.slowdown, status


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
            until(self._subscriber.get_num_connections, '%s is published' % name)

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


def command_topic(name, message_class):
    """A publisher; waits until the bridge has subscribed."""
    topic = rospy.Publisher(name, message_class, queue_size=100, tcp_nodelay=True)
    until(topic.get_num_connections, 'the bridge subscribes to %s' % name)
    return topic


def settle(node, board):
    """Wait until the bus of `node` is in step and idle; clear the records of `board`."""
    board.script.clear()
    board.rule = lambda request: None
    echo = service('/%s/bus/echo' % node, Trigger)
    until(lambda: board.connected, 'the board has its port')
    until(lambda: echo().success, 'the bus answers ECHO')
    board.forget()


def values_of(message, *names):
    """The fields with these names, as a tuple."""
    return tuple(getattr(message, name) for name in names)
