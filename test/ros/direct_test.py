#!/usr/bin/python3
"""Subscribers that stop reading, over real TCP connections, while others continue."""
import io
import socket
import struct
import unittest
from unittest import mock
from xmlrpc.client import ServerProxy

import rosgraph
import rospy
import rostest
from rosgraph.network import encode_ros_handshake_header, read_ros_handshake_header
from std_msgs.msg import String

from boards import PACKAGE, PATIENCE, Topic, Waiter, until
from serial_communication.ros import direct

_BIG = 'x' * (32 << 20)      # bytes; more than the kernel buffers for one connection


def setUpModule():
    """Install our connection class, but not in a rospy that is not known."""
    before = rospy.topics.QueuedConnection
    with mock.patch.object(direct, '_KNOWN', 'another'):
        assert not direct.install() and rospy.topics.QueuedConnection is before
    assert direct.install() and rospy.topics.QueuedConnection is direct.DirectConnection


class RawSubscriber:
    """A connection to a publisher of this process that reads only on request."""

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
        # Read one byte at a time: the bytes after the header belong to a message.
        read_ros_handshake_header(self.socket, io.BytesIO(), 1)

    def read(self):
        """Read the next message."""
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
    """A subscriber that does not read; each test has its own topic."""

    def begin(self, queue_size):
        self.topic = rospy.resolve_name(f'~{self._testMethodName}')
        self.publisher = rospy.Publisher(self.topic, String, queue_size=queue_size)
        self.addCleanup(self.publisher.unregister)
        self.slow = RawSubscriber(self.topic)
        self.addCleanup(self.slow.socket.close)
        until(lambda: self.publisher.get_num_connections() == 1, 'it is connected')

    def slow_subscribers(self):
        """The connections whose sockets are full."""
        return [each for each in self.publisher.impl.connections if each._rest]

    def listen(self):
        """Add another subscriber, which reads."""
        other = Topic(self.topic, String)
        self.addCleanup(other.close)
        return other

    def publish(self, text):
        """Publish in a thread, which fails the test if it blocks."""
        Waiter(self.publisher.publish, text).result()

    def test_it_gets_all_messages_in_order_and_delays_no_other_subscriber(self):
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

    def test_a_full_queue_drops_its_oldest_message_and_never_part_of_one(self):
        self.begin(queue_size=2)
        self.publish(_BIG)
        self.assertEqual(len(self.slow_subscribers()), 1)
        for number in range(10):
            self.publish(str(number))
        self.assertTrue(self.slow.read() == _BIG)
        self.assertEqual([self.slow.read(), self.slow.read()], ['8', '9'])

    def test_a_subscriber_that_disconnects_is_removed_and_the_others_continue(self):
        self.begin(queue_size=2)
        self.publish(_BIG)
        self.slow.socket.close()
        until(lambda: not self.publisher.get_num_connections(), 'it is forgotten',
              doing=lambda: self.publish('anybody?'))
        self.listen().first(lambda m: m.data == 'after', doing=lambda: self.publish('after'))


if __name__ == '__main__':
    rospy.init_node('direct_test')
    rostest.rosrun(PACKAGE, 'direct', '__main__')
