#!/usr/bin/python3
"""A subscriber that stops reading, over a real TCP connection, while others read on."""
import io
import logging
import socket
import struct
import threading
import unittest
from unittest import mock
from xmlrpc.client import ServerProxy

import rosgraph
import rospy
import rostest
from rosgraph.network import encode_ros_handshake_header, read_ros_handshake_header
from std_msgs.msg import String

from boards import PACKAGE, PATIENCE, Topic, Waiter, until
from serial_communication.ros.rospy_mends import direct

_BIG = 'x' * (32 << 20)      # more than the kernel holds for one connection


def setUpModule():
    """rospy's own connection, and the one that takes its place."""
    global QUEUED, INSTALLED
    QUEUED = rospy.topics.QueuedConnection
    direct.install(logging.getLogger('rosout'))
    INSTALLED = rospy.topics.QueuedConnection


class RawSubscriber:
    """A connection to a publisher of this process, from which nothing is read unasked."""

    def __init__(self, topic, name='/raw'):
        uri = rosgraph.Master('/raw').lookupNode(rospy.get_name())
        _, _, (_, host, port) = ServerProxy(uri).requestTopic('/raw', topic, [['TCPROS']])
        self.socket = socket.socket()
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        self.socket.settimeout(PATIENCE)
        self.socket.connect((host, port))
        self.socket.sendall(encode_ros_handshake_header(
            {'callerid': name, 'topic': topic, 'type': String._type,
             'md5sum': String._md5sum}))
        # One byte at a time: what follows the header is a message's.
        read_ros_handshake_header(self.socket, io.BytesIO(), 1)

    def read(self):
        """The next message."""
        size, = struct.unpack('<I', self._read(4))
        return String().deserialize(self._read(size)).data

    def _read(self, size):
        data = bytearray()
        while len(data) < size:
            part = self.socket.recv(size - len(data))
            assert part, 'the publisher closed the connection'
            data += part
        return bytes(data)


class SlowSubscriber(unittest.TestCase):
    """Each test on a topic of its own."""

    def begin(self, queue_size):
        self.topic = rospy.resolve_name(f'~{self._testMethodName}')
        self.publisher = rospy.Publisher(self.topic, String, queue_size=queue_size)
        self.addCleanup(self.publisher.unregister)
        self.slow = RawSubscriber(self.topic)
        self.addCleanup(self.slow.socket.close)
        until(lambda: self.publisher.get_num_connections() == 1, 'it is connected')

    def slow_subscribers(self):
        """The connections whose sockets are full."""
        return [each for each in self.publisher.impl.connections if each._is_slow]

    def listen(self):
        """Another subscriber, which reads."""
        other = Topic(self.topic, String)
        self.addCleanup(other.close)
        return other

    def publish(self, text):
        """In a thread that may be held up, but must not."""
        Waiter(self.publisher.publish, text).result()

    def test_what_it_has_not_read_is_complete_and_in_order_and_holds_up_nobody(self):
        self.begin(queue_size=0)
        other, sent = self.listen(), []
        until(lambda: self.publisher.get_num_connections() == 2, 'both are connected')

        def publish():
            sent.append(str(len(sent)) * 3001)
            self.publish(sent[-1])
            self.assertEqual(other.first(lambda m: m.data == sent[-1]).data, sent[-1])

        until(self.slow_subscribers, 'its socket is full', doing=publish, every=0)
        self.assertEqual(len(self.slow_subscribers()), 1, 'the other one is not slow')
        for _ in range(100):
            publish()
        self.assertEqual([m.data for m in other.messages], sent)
        self.assertTrue([self.slow.read() for _ in sent] == sent)
        until(lambda: not self.slow_subscribers(), 'it is sent to directly again')
        publish()
        self.assertEqual(self.slow.read(), sent[-1])
        self.assertEqual(self.slow_subscribers(), [])

    def test_a_queue_drops_its_oldest_and_never_the_rest_of_a_message(self):
        self.begin(queue_size=2)
        self.publish(_BIG)
        self.assertEqual(len(self.slow_subscribers()), 1)
        for number in range(10):
            self.publish(str(number))
        self.assertTrue(self.slow.read() == _BIG)
        self.assertEqual([self.slow.read(), self.slow.read()], ['8', '9'])

    def test_a_slow_subscriber_does_not_hold_up_another_slow_one(self):
        self.begin(queue_size=2)
        other = RawSubscriber(self.topic, '/another')
        self.addCleanup(other.socket.close)
        until(lambda: self.publisher.get_num_connections() == 2, 'both are connected')
        self.publish(_BIG)
        self.assertEqual(len(self.slow_subscribers()), 2)
        self.publish('behind it')
        self.assertTrue(other.read() == _BIG)
        self.assertEqual(other.read(), 'behind it')
        self.assertEqual(len(self.slow_subscribers()), 1, 'the first one has not read a byte')
        self.assertTrue(self.slow.read() == _BIG)
        self.assertEqual(self.slow.read(), 'behind it')

    def test_no_thread_is_started_for_it(self):
        """Where no memory is left, Thread.start may never return."""
        self.begin(queue_size=2)

        def never_returns(thread):
            raise AssertionError(f'{thread.name} is started')

        with mock.patch.object(threading.Thread, 'start', never_returns):
            self.publisher.publish(_BIG)
            self.assertEqual(len(self.slow_subscribers()), 1)
            self.publisher.publish('behind it')
            self.assertTrue(self.slow.read() == _BIG)
            self.assertEqual(self.slow.read(), 'behind it')

    def test_one_that_goes_is_forgotten_and_the_others_go_on(self):
        self.begin(queue_size=2)
        self.publish(_BIG)
        self.slow.socket.close()
        until(lambda: not self.publisher.get_num_connections(), 'it is forgotten',
              doing=lambda: self.publish('anybody?'))
        self.listen().first(lambda m: m.data == 'after', doing=lambda: self.publish('after'))

    def tearDown(self):
        self.doCleanups()
        until(lambda: not direct._sender._slow, 'nothing is kept')


class Another:
    """A QueuedConnection as no rospy that we know has it."""

    def __init__(self, connection, queue_size):
        self._connection = connection
        self._limit = queue_size


class AnotherRospy(unittest.TestCase):
    """What it was not written against stays as it is, and a line says so."""

    def test_another_connection_is_left_alone(self):
        with mock.patch('rospy.topics.QueuedConnection', Another), \
                self.assertLogs('another', logging.WARNING) as log:
            direct.install(logging.getLogger('another'))
            self.assertIs(rospy.topics.QueuedConnection, Another)
        self.assertEqual(len(log.output), 1)

    def test_a_transport_without_a_socket_is_left_alone(self):
        with mock.patch('rospy.topics.QueuedConnection', QUEUED), \
                mock.patch.object(direct, 'TCPROSTransport', Another), \
                self.assertLogs('another', logging.WARNING):
            direct.install(logging.getLogger('another'))
            self.assertIs(rospy.topics.QueuedConnection, QUEUED)

    def test_the_one_that_is_installed_here_fits(self):
        self.assertIs(INSTALLED, direct.DirectConnection)


if __name__ == '__main__':
    rospy.init_node('direct_test')
    rostest.rosrun(PACKAGE, 'direct', '__main__')
