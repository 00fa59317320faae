#!/usr/bin/python3
"""New subscribers, callers and publishers are served, whatever others do or did before."""
import io
import os
import resource
import select
import shutil
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
from roscpp.srv import GetLoggers
from rospy.impl import registration, tcpros_base, tcpros_pubsub

from boards import (PACKAGE, PATIENCE, Bridge, CarBoard, Line, command_topic, own_folder, service,
                    until)
from serial_communication.link.sparing_log import SparingLog
from serial_communication.msg import SpeedPWMCommand, Voltage
from serial_communication.boards.arduino import wire as arduino
from serial_communication.ros.rospy_mends import handshake, shortage

NAME = '/' + PACKAGE
MASTER = rosgraph.Master('/doors_test')


def connected(address):
    """A connection to a node's ROS port."""
    return socket.create_connection(address, PATIENCE)


def service_address(name):
    """Host and port that serve it."""
    parts = urlsplit(MASTER.lookupService(name))
    return parts.hostname, parts.port


def shake(connection, **fields):
    """Do the handshake; the node's header, or None where it closes the connection."""
    connection.sendall(encode_ros_handshake_header(
        {'callerid': '/doors_test', 'md5sum': '*', **fields}))
    try:
        # One byte at a time: what follows the header is a message's.
        return read_ros_handshake_header(connection, io.BytesIO(), 1)
    except (rosgraph.network.ROSHandshakeException, OSError):
        return None


def is_closed(connection):
    """Whether the node has closed it without a word."""
    if not select.select([connection], [], [], 0)[0]:
        return False
    try:
        return connection.recv(1) == b''
    except OSError:
        return True


class Short(unittest.TestCase):
    """A bridge that is short of something for a while."""

    def setUp(self):
        self.folder = own_folder()
        self.line = Line(os.path.join(self.folder, 'arduino')).plug()
        self.car = CarBoard(self.line.far)
        self.open = []

    def start(self, before=()):
        self.bridge = Bridge(parameters={'arduino/port': self.line.near}, before=before)
        rospy.wait_for_service(NAME + '/calibrate_imu', PATIENCE)
        self.car.wait_for_heartbeats(1)

    def tearDown(self):
        for connection in self.open:
            connection.close()
        if self.bridge.alive:
            self.bridge.process.kill()
            self.bridge.process.wait(10)
        self.car.close()
        self.line.unplug()
        shutil.rmtree(self.folder)

    def assert_everybody_is_served(self):
        """A subscriber, a caller and a publisher that come now."""
        with connected(service_address(NAME + '/get_loggers')) as subscriber:
            header = shake(subscriber, topic=NAME + '/voltage', type=Voltage._type)
            self.assertEqual(header['type'], Voltage._type)
            self.car.say(arduino.Voltage(12.0))
            size, = struct.unpack('<I', subscriber.recv(4, socket.MSG_WAITALL))
            message = Voltage().deserialize(subscriber.recv(size, socket.MSG_WAITALL))
            self.assertEqual(message.value, 12.0)
        self.assertTrue(service(NAME + '/get_loggers', GetLoggers)().loggers)
        self.assert_drives(400)

    def assert_drives(self, value):
        """A new publisher of speeds is connected."""
        speed = command_topic(NAME + '/speed', SpeedPWMCommand)
        until(lambda: value in self.car.speeds, 'the car drives',
              doing=lambda: speed.publish(value=value), every=0.05)
        speed.unregister()


class OutOfDescriptors(Short):
    """More subscribers than it has file descriptors for; then they go."""

    def setUp(self):
        super().setUp()
        self.start(before=('sh', '-c', 'ulimit -n 128; exec "$@"', 'limited'))
        self.address = service_address(NAME + '/get_loggers')

    def cpu(self):
        """Seconds of processor that the bridge has used."""
        with open('/proc/%d/stat' % self.bridge.process.pid) as file:
            fields = file.read().rpartition(')')[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')

    def subscribe(self):
        """One more, without waiting."""
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

    def test_all_are_served_after_they_have_gone(self):
        began = time.monotonic()
        until(lambda: 'out of file descriptors (ulimit -n is 128)' in self.bridge.output(),
              'there are more than it can take', doing=self.subscribe)
        self.open.append(connected(urlsplit(MASTER.lookupNode(NAME)).netloc.split(':')))
        late = rospy.Publisher(NAME + '/speed', SpeedPWMCommand, queue_size=1)
        self.addCleanup(late.unregister)
        used, now = self.cpu(), time.monotonic()
        self.car.forget()
        self.car.wait_for_heartbeats(100)
        self.assertLess(self.cpu() - used, 0.5 * (time.monotonic() - now))
        for connection in self.open:
            connection.close()
        until(lambda: 300 in self.car.speeds, 'who came meanwhile is connected',
              2 * PATIENCE, doing=lambda: late.publish(value=300), every=0.05)
        self.assert_everybody_is_served()
        lines = self.bridge.output().count('out of file descriptors')
        self.assertLessEqual(lines, 1 + (time.monotonic() - began) / 10.0, self.bridge.output())


class OutOfThreads(Short):
    """No memory for another thread, as a hundred publishers come."""

    def test_publishers_are_connected_as_soon_as_there_is_memory(self):
        self.start()
        pid = self.bridge.process.pid
        # Kept open, so that its calls need no new thread.
        node = ServerProxy(MASTER.lookupNode(NAME))
        node.getPid('/doors_test')
        with socket.socket() as hangs:      # nothing answers there: each takes a thread
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
    """This process is the node. Nobody's time is over unless a test says so."""

    def setUp(self):
        self.address = service_address(rospy.resolve_name('~get_loggers'))
        patience = mock.patch.object(handshake, '_PATIENCE', 3600.0)
        patience.start()
        self.addCleanup(patience.stop)

    def connect(self, first=b''):
        """A connection that has sent this."""
        connection = connected(self.address)
        self.addCleanup(connection.close)
        connection.sendall(first)
        return connection

    def call(self, **fields):
        """The header that answers a caller's, who is served."""
        with connected(self.address) as caller:
            header = shake(caller, service=rospy.resolve_name('~get_loggers'), **fields)
        self.assertEqual(header['type'], 'roscpp/GetLoggers')

    def test_those_that_have_not_finished_their_header_hold_up_nobody(self):
        slow = [self.connect(first) for first in (b'', b'\x40', b'\x40\0\0\0', b'\x40\0\0\0half')
                for _ in range(5)]
        self.call()
        self.assertFalse(any(is_closed(each) for each in slow))

    def test_a_header_in_pieces_is_taken(self):
        whole = encode_ros_handshake_header({'callerid': '/doors_test', 'md5sum': '*', 'service':
                                             rospy.resolve_name('~get_loggers')})
        caller = self.connect()
        caller.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for byte in whole:
            caller.sendall(bytes([byte]))
        header = read_ros_handshake_header(caller, io.BytesIO(), 4096)
        self.assertEqual(header['type'], 'roscpp/GetLoggers')

    def test_what_is_too_long_for_a_header_is_closed_at_once(self):
        for size in (64 << 10) + 1, (2 << 30) - 1, (4 << 30) - 1:
            with self.subTest(size):
                self.assertEqual(self.connect(struct.pack('<I', size)).recv(1), b'')
        self.call(more='x' * 60000)

    def test_one_deadline_for_all_of_it(self):
        header = iter(struct.pack('<I', 60000) + bytes(60000))

        def drip():
            try:
                slow.sendall(bytes([next(header)]))
            except OSError:
                pass        # it is closed
        with mock.patch.object(handshake, '_PATIENCE', 1.0):
            slow = self.connect()
            until(lambda: is_closed(slow), 'it is closed', doing=drip, every=0.2)

    def test_of_more_than_64_the_oldest_has_to_go(self):
        slow = [self.connect() for _ in range(70)]
        until(lambda: is_closed(slow[0]), 'the oldest is closed')
        self.call()
        until(lambda: [is_closed(each) for each in slow[:8]] == [True] * 7 + [False],
              'one for each that came later')
        self.assertFalse(any(is_closed(each) for each in slow[8:]))

    def test_a_handler_that_raises_shuts_out_nobody(self):
        server = tcpros_base._tcpros_server.tcp_ros_server
        with mock.patch.object(server, 'inbound_handler', side_effect=MemoryError('no more')):
            self.assertIsNone(shake(self.connect(), service='/any'))
        self.call()


class AnotherRospy(unittest.TestCase):
    """What it was not written against stays as it is, and a line says so."""

    def assert_left_alone(self, install, holder, name):
        before = getattr(holder, name)
        log = mock.Mock()
        install(SparingLog('ROS', log))
        self.assertIs(getattr(holder, name), before)
        (_level, form, *values), = [call[0] for call in log.log.call_args_list]
        self.assertIn('differently from 1.15.15 and 1.16.0', form % tuple(values))

    def test_a_server_that_takes_connections_in_another_way(self):
        def run(server):
            """Unlike all that are known."""
            server.serve()
        with mock.patch.object(tcpros_base.TCPServer, 'run', run):
            self.assert_left_alone(handshake.install, tcpros_base.TCPServer, 'run')

    def test_a_server_that_reads_headers_in_another_way(self):
        with mock.patch.object(tcpros_base.TCPServer, 'run', RUN), \
                mock.patch.object(tcpros_base.TCPROSServer, '_tcp_server_callback', RUN):
            self.assert_left_alone(handshake.install, tcpros_base.TCPServer, 'run')

    def test_modules_that_have_no_threads_of_their_own(self):
        with mock.patch.object(tcpros_pubsub, 'threading', None):
            self.assert_left_alone(shortage.install, registration, 'threading')

    def test_the_one_that_is_installed_here_fits(self):
        self.assertIsNot(tcpros_base.TCPServer.run, RUN)
        self.assertIsNot(registration.threading, threading)


class PatientThread(unittest.TestCase):
    """What starts the threads of connections to publishers."""

    def test_a_thread_that_has_been_started_cannot_be_started_again(self):
        thread = registration.threading.Thread(target=lambda: None)
        thread.start()
        thread.join()
        with self.assertRaises(RuntimeError):
            thread.start()


if __name__ == '__main__':
    RUN = tcpros_base.TCPServer.run
    LOG = SparingLog('ROS', mock.Mock())
    handshake.install(LOG)
    shortage.install(LOG)
    rospy.init_node('doors_test')
    rostest.rosrun(PACKAGE, 'doors', '__main__')
