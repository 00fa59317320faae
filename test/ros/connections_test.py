#!/usr/bin/python3
"""New subscribers, callers and publishers are served, whatever other connections do or did."""
import io
import os
import resource
import select
import socket
import struct
import threading
import time
import unittest
from unittest import mock
from urllib.parse import urlsplit
from xmlrpc.client import ServerProxy

import rosgraph
import rospy
import rostest
from rosgraph.network import encode_ros_handshake_header, read_ros_handshake_header
from roscpp.srv import GetLoggers, GetLoggersResponse
from rospy.impl import registration, tcpros_base

from boards import (PACKAGE, PATIENCE, BoardsTest, CarBoard, Waiter, again_if_stalled,
                    command_topic, service, service_address, until)
from serial_communication.link.sparing_log import SparingLog
from serial_communication.msg import SpeedPWMCommand, Voltage
from serial_communication.boards.arduino import wire as arduino
from serial_communication.ros import traffic
from serial_communication.ros.rospy_mends import connections, handshake, shortage
from serial_communication.ros.traffic import Traffic

NAME = '/' + PACKAGE
MASTER = rosgraph.Master('/connections_test')


def connected(address):
    """Connect to a node's ROS port."""
    return socket.create_connection(address, PATIENCE)


def shake(connection, **fields):
    """Do the handshake; return the node's header, or None if it closes the connection."""
    connection.sendall(encode_ros_handshake_header(
        {'callerid': '/connections_test', 'md5sum': '*', **fields}))
    try:
        # Read one byte at a time: the bytes after the header belong to a message.
        return read_ros_handshake_header(connection, io.BytesIO(), 1)
    except (rosgraph.network.ROSHandshakeException, OSError):
        return None


def is_closed(connection):
    """Whether the node has closed it without sending anything."""
    if not select.select([connection], [], [], 0)[0]:
        return False
    try:
        return connection.recv(1) == b''
    except OSError:
        return True


class Short(BoardsTest):
    """A bridge that runs out of something for a while."""

    def setUp(self):
        super().setUp()
        self.car = self.plug('arduino', CarBoard)
        self.open = []

    def start(self, before=()):
        self.bridge = self.start_bridge(
            parameters={'arduino/port': self.lines['arduino'].near}, before=before)
        rospy.wait_for_service(NAME + '/calibrate_imu', PATIENCE)
        self.car.wait_for_heartbeats(1)

    def tearDown(self):
        for connection in self.open:
            connection.close()

    def assert_everybody_is_served(self):
        """A new subscriber, a new caller and a new publisher are served."""
        with connected(service_address(NAME + '/get_loggers')) as subscriber:
            header = shake(subscriber, topic=NAME + '/voltage', type=Voltage._type)
            self.assertEqual(header['type'], Voltage._type)
            until(lambda: select.select([subscriber], [], [], 0)[0], 'a voltage is published',
                  doing=lambda: self.car.say(arduino.Voltage(12.0)), every=0.05)
            size, = struct.unpack('<I', subscriber.recv(4, socket.MSG_WAITALL))
            message = Voltage().deserialize(subscriber.recv(size, socket.MSG_WAITALL))
            self.assertEqual(message.value, 12.0)
        self.assertTrue(service(NAME + '/get_loggers', GetLoggers)().loggers)
        self.assert_drives(400)

    def assert_drives(self, value):
        """Speeds of a new publisher reach the car."""
        speed = command_topic(NAME + '/speed', SpeedPWMCommand)
        until(lambda: value in self.car.speeds, 'the car drives',
              doing=lambda: speed.publish(value=value), every=0.05)
        speed.unregister()


class OutOfDescriptors(Short):
    """More subscribers than file descriptors; then they disconnect."""

    def setUp(self):
        super().setUp()
        self.start(before=('sh', '-c', 'ulimit -n 128; exec "$@"', 'limited'))
        self.address = service_address(NAME + '/get_loggers')

    def cpu(self):
        """The processor time that the bridge has used, in s."""
        with open('/proc/%d/stat' % self.bridge.process.pid) as file:
            fields = file.read().rpartition(')')[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')

    def subscribe(self):
        """Add a subscriber, without waiting."""
        connection = socket.socket()
        self.open.append(connection)
        connection.setblocking(False)
        connection.connect_ex(self.address)
        try:
            connection.sendall(encode_ros_handshake_header(
                {'callerid': f'/one_of_many_{len(self.open)}', 'md5sum': '*',
                 'topic': NAME + '/voltage'}))
        except OSError:
            pass        # the node's queue is full

    def test_everybody_is_served_after_they_have_disconnected(self):
        began = time.monotonic()
        until(lambda: 'out of file descriptors (ulimit -n is 128)' in self.bridge.output(),
              'there are more than it can take', doing=self.subscribe)
        self.open.append(connected(urlsplit(MASTER.lookupNode(NAME)).netloc.split(':')))
        late = rospy.Publisher(NAME + '/speed', SpeedPWMCommand, queue_size=1)
        self.addCleanup(late.unregister)
        used, now = self.cpu(), time.monotonic()
        self.car.forget()
        self.car.wait_for_heartbeats(100)
        # The board may have read heartbeats from before, all at once.
        until(lambda: time.monotonic() > now + 1.0, 'a second passes')
        self.assertLess(self.cpu() - used, 0.5 * (time.monotonic() - now))
        for connection in self.open:
            connection.close()
        until(lambda: 300 in self.car.speeds, 'who came meanwhile is connected',
              doing=lambda: late.publish(value=300), every=0.05)
        self.assert_everybody_is_served()
        lines = self.bridge.output().count('out of file descriptors')
        self.assertLessEqual(lines, 1 + (time.monotonic() - began) / 10.0, self.bridge.output())


class OutOfThreads(Short):
    """No memory for another thread while a hundred publishers connect."""

    def test_publishers_are_connected_as_soon_as_there_is_memory(self):
        self.start()
        pid = self.bridge.process.pid
        # Keep the connection open, so that its calls need no new thread.
        node = ServerProxy(MASTER.lookupNode(NAME))
        node.getPid('/connections_test')
        with socket.socket() as hangs:      # nothing answers there, so each takes a thread
            hangs.bind(('127.0.0.1', 0))
            hangs.listen(128)
            publishers = ['http://127.0.0.1:%d/%d' % (hangs.getsockname()[1], number)
                          for number in range(100)]
            with open('/proc/%d/statm' % pid) as file:
                size = int(file.read().split()[0]) * resource.getpagesize()
            _, hard = resource.prlimit(pid, resource.RLIMIT_AS)
            resource.prlimit(pid, resource.RLIMIT_AS, (size + (64 << 20), hard))
            node.publisherUpdate('/master', NAME + '/speed', publishers)
            self.bridge.wait_for("can't start new thread")
            resource.prlimit(pid, resource.RLIMIT_AS, (hard, hard))
        self.assert_everybody_is_served()


class Handshakes(unittest.TestCase):
    """This process is the node. Its time limit for headers is long unless a test changes it."""

    def setUp(self):
        self.address = service_address(rospy.resolve_name('~get_loggers'))
        patience = mock.patch.object(handshake, '_PATIENCE', 3600.0)
        patience.start()
        self.addCleanup(patience.stop)

    def connect(self, first=b''):
        """Open a connection and send this."""
        connection = connected(self.address)
        self.addCleanup(connection.close)
        connection.sendall(first)
        return connection

    def call(self, **fields):
        """Send a caller's header; return the node's."""
        with connected(self.address) as caller:
            header = shake(caller, service=rospy.resolve_name('~get_loggers'), **fields)
        self.assertEqual(header['type'], 'roscpp/GetLoggers')

    def test_connections_with_an_incomplete_header_delay_nobody(self):
        slow = [self.connect(first) for first in (b'', b'\x40', b'\x40\0\0\0', b'\x40\0\0\0half')
                for _ in range(5)]
        self.call()
        self.assertFalse(any(is_closed(each) for each in slow))

    def test_a_header_in_pieces_is_accepted(self):
        whole = encode_ros_handshake_header({'callerid': '/connections_test', 'md5sum': '*',
                                             'service': rospy.resolve_name('~get_loggers')})
        caller = self.connect()
        caller.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for byte in whole:
            caller.sendall(bytes([byte]))
        header = read_ros_handshake_header(caller, io.BytesIO(), 4096)
        self.assertEqual(header['type'], 'roscpp/GetLoggers')

    def test_a_connection_with_too_long_a_header_is_closed_at_once(self):
        for size in (64 << 10) + 1, (2 << 30) - 1, (4 << 30) - 1:
            with self.subTest(size):
                self.assertEqual(self.connect(struct.pack('<I', size)).recv(1), b'')
        self.call(more='x' * 60000)

    def test_the_deadline_is_for_the_complete_header(self):
        header = iter(struct.pack('<I', 60000) + bytes(60000))

        def drip():
            try:
                slow.sendall(bytes([next(header)]))
            except OSError:
                pass        # it is closed
        with mock.patch.object(handshake, '_PATIENCE', 1.0):
            slow = self.connect()
            until(lambda: is_closed(slow), 'it is closed', doing=drip, every=0.2)

    def test_of_more_than_64_pending_connections_the_oldest_is_closed(self):
        self.assertEqual(handshake._MOST_PENDING, 64)
        with mock.patch.object(handshake, '_MOST_PENDING', 6):
            slow = [self.connect() for _ in range(9)]
            until(lambda: is_closed(slow[0]), 'the oldest is closed')
            self.call()
            # One for each that came later; the call was one, too.
            until(lambda: [is_closed(each) for each in slow] == [True] * 4 + [False] * 5,
                  'the first four are closed')

    def test_after_a_handler_raises_others_are_still_served(self):
        server = tcpros_base._tcpros_server.tcp_ros_server
        with mock.patch.object(server, 'inbound_handler', side_effect=MemoryError('no more')):
            self.assertIsNone(shake(self.connect(), service='/any'))
        self.call()

    def test_after_a_shortage_of_memory_in_the_loop_itself_others_are_still_served(self):
        for part in (handshake._PendingConnection, 'read'), (handshake._Acceptor, '_accept'):
            with self.subTest(part[1]):
                served = []
                server = tcpros_base.TCPServer(lambda *given, into=served: into.append(given), 0)
                self.addCleanup(server.shutdown)
                self.address = server.get_full_addr()
                with mock.patch.object(*part, side_effect=MemoryError('no more')) as fails:
                    Waiter(server.run)
                    self.connect()
                    until(lambda: fails.called, 'it fails')
                self.connect(encode_ros_handshake_header({'callerid': '/connections_test'}))
                until(lambda: served, 'another connection is served')
                served[0][0].close()


class ConnectedService(unittest.TestCase):
    """How long the connection to a service is waited for, and its answer."""

    def test_a_service_that_accepts_and_answers_nothing_is_given_up(self):
        with socket.socket() as hangs:
            hangs.bind(('127.0.0.1', 0))
            hangs.listen(1)
            uri = 'rosrpc://127.0.0.1:%d' % hangs.getsockname()[1]
            with mock.patch.object(rosgraph.Master, 'lookupService', return_value=uri):
                attempt = Waiter(connections.connected_service, '/any', GetLoggers, 0.5)
                with self.assertRaises(rospy.TransportInitError):
                    attempt.result()
        self.assertGreater(attempt.took, 0.4)

    def test_a_service_may_take_longer_to_answer_than_to_connect(self):
        patience, answers = 1.0, threading.Event()

        def slow(_request):
            answers.wait(PATIENCE)
            return GetLoggersResponse()
        name = rospy.resolve_name('~slow')
        offered = rospy.Service(name, GetLoggers, slow)
        self.addCleanup(offered.shutdown)

        def connect():
            try:
                return connections.connected_service(name, GetLoggers, patience)
            except rospy.TransportInitError:
                return None     # this machine stalled
        proxy = again_if_stalled(connect)
        began, call = time.monotonic(), Waiter(proxy)
        until(lambda: time.monotonic() - began > 1.5 * patience, 'more time passes')
        answers.set()
        self.assertEqual(call.result(), GetLoggersResponse())


class TrafficSubscribers(unittest.TestCase):
    """Subscribers of serial_msg."""

    def test_two_that_leave_in_the_same_moment_do_not_wait_for_each_other(self):
        """One of them while rospy's thread holds its lock; else nobody is connected any more."""
        topic, asks = Traffic([], mock.Mock()), threading.Event()
        rospys_lock, wanted = topic._topic.impl.c_lock, traffic.wanted

        def other_leaves():
            with rospys_lock:
                leaving.append(Waiter(lambda: topic.peer_unsubscribe('/serial_msg', 1)))
                self.assertTrue(asks.wait(PATIENCE))
                topic.peer_unsubscribe('/serial_msg', 0)

        def asked(publisher):
            asks.set()
            return wanted(publisher)

        leaving = []
        with mock.patch.object(traffic, 'wanted', asked):
            leaving.append(Waiter(other_leaves))
            until(lambda: len(leaving) == 2 and not any(each.is_alive() for each in leaving),
                  'both have left')


class PatientThread(unittest.TestCase):
    """The threads of connections to publishers."""

    def test_a_thread_that_has_been_started_cannot_be_started_again(self):
        thread = registration.threading.Thread(target=lambda: None)
        thread.start()
        thread.join()
        with self.assertRaises(RuntimeError):
            thread.start()


if __name__ == '__main__':
    LOG = SparingLog('ROS', mock.Mock())
    handshake.install(LOG)
    shortage.install(LOG)
    rospy.init_node('connections_test')
    rostest.rosrun(PACKAGE, 'connections', '__main__')
