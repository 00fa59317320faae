"""A subscriber that stops reading, on a real connection of rospy. Needs ROS, but no master."""
import socket
from unittest import mock

import pytest
from waiting import until

rospy = pytest.importorskip('rospy')
from rospy.exceptions import TransportTerminated  # noqa: E402
from rospy.impl.tcpros_base import TCPROSTransport, TCPROSTransportProtocol  # noqa: E402

from serial_communication.ros import direct  # noqa: E402

BIG = bytes(range(1, 256)) * 40000      # more than the kernel buffers for one connection


@pytest.fixture
def subscribe():
    """A function that makes a connection with a queue of this size, and the subscriber's socket."""
    made = []

    def connect(queue_size):
        ours, theirs = socket.socketpair()
        transport = TCPROSTransport(TCPROSTransportProtocol('/topic', rospy.AnyMsg), '/topic')
        transport.set_socket(ours, '/topic')
        made.append((direct.DirectConnection(transport, queue_size), theirs))
        made[-1][0]._thread.name = 'subscriber'
        return made[-1]
    yield connect
    for connection, theirs in made:
        theirs.close()
        connection.close()


def read(theirs, size):
    """So many bytes."""
    data = bytearray()
    while len(data) < size:
        data += theirs.recv(size - len(data))
    return bytes(data)


def test_all_messages_arrive_in_order_and_no_write_waits(subscribe):
    connection, theirs = subscribe(0)
    sent = [b'first', BIG, *(b'%05d' % number for number in range(1000)), BIG]
    for message in sent:
        connection.write_data(message)
    assert read(theirs, sum(map(len, sent))) == b''.join(sent)
    until(lambda: not connection._rest, 'it is sent to directly again')
    connection.write_data(b'last')
    assert read(theirs, 4) == b'last' and not connection._rest


def test_a_full_queue_drops_its_oldest_message_and_never_part_of_one(subscribe):
    connection, theirs = subscribe(2)
    for message in (BIG, *(b'%d' % number for number in range(10))):
        connection.write_data(message)
    assert read(theirs, len(BIG) + 2) == BIG + b'89'


def test_a_subscriber_that_disconnects_is_told_to_the_publisher(subscribe):
    connection, theirs = subscribe(2)
    connection.write_data(BIG)
    theirs.close()
    until(lambda: connection.done, 'the rest cannot be sent')
    with pytest.raises(TransportTerminated):
        connection.write_data(b'anybody?')


def test_a_rospy_that_is_not_known_is_not_patched():
    with mock.patch('rospy.topics.QueuedConnection', rospy.topics.QueuedConnection) as before:
        with mock.patch.object(direct, '_KNOWN', 'another'):
            assert not direct.install() and rospy.topics.QueuedConnection is before
        assert direct.install() and rospy.topics.QueuedConnection is direct.DirectConnection
