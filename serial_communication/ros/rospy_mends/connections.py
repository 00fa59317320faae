"""Connections of topics and services: which one a message came on, and whom a topic reaches."""
import socket
import struct
from typing import Any, Dict

import rosgraph
import rospy
from rospy.impl.tcpros_base import TCPROSTransport

from .private_parts import Guard

_TOPICS = Guard('rospy.topics:_TopicImpl.add_connection rospy.topics:_TopicImpl._remove_connection '
                'rospy.topics:_TopicImpl.has_connection '
                'rospy.impl.tcpros_base:TCPROSTransport.receive_once '
                'rospy.impl.tcpros_base:TCPROSTransport.read_header', {'172d8dd7f6354a16'},
                'keeps connections', 'commands on an old connection are not refused, and the page '
                'does not see whether the bridge receives its commands')
_SERVICES = Guard('rospy.impl.tcpros_service:ServiceProxy.__init__ '
                  'rospy.impl.tcpros_service:ServiceProxy.call '
                  'rospy.impl.tcpros_base:TCPROSTransport.__init__ '
                  'rospy.impl.tcpros_base:TCPROSTransport.connect '
                  'rospy.impl.tcpros_base:TCPROSTransport.read_header '
                  'rosgraph.network:read_ros_handshake_header', {'89a41e07a4751c60'},
                  'calls services', 'a call from the page may wait for the master, and is then '
                  'sent late')


def header_of(message: Any) -> Dict[str, str]:
    """Return the header of the connection on which a message came: one object for each."""
    return getattr(message, '_connection_header', {})


def packed(message: rospy.AnyMsg) -> bytes:
    """Return the serialized message."""
    return message._buff


class NewestConnections:
    """Finds the messages of connections whose publisher has made a newer one."""

    def __init__(self, subscriber: rospy.Subscriber) -> None:
        self._impl = subscriber.impl if _TOPICS.passes() else None
        self._replaced: Dict[int, Any] = {}     # headers of those that have newer ones, by their id

    def is_replaced(self, header: Dict[str, str]) -> bool:
        """Return whether the publisher has made a newer connection, even if that has closed."""
        if self._impl is None:
            return False
        # rospy keeps them in the order in which it made them. One without a header is not ready.
        alive = [each.header for each in self._impl.connections if each.header]
        sender = header.get('callerid', '')
        older = [each for each in alive if each.get('callerid', '') == sender][:-1]
        ids = {id(each) for each in alive}
        self._replaced = {id(each): each for each in (*self._replaced.values(), *older)
                          if id(each) in ids}
        return id(header) in self._replaced or id(header) not in ids


def reaches(publisher: rospy.Publisher, node: str) -> bool:
    """Return whether a node, by its full name, subscribes to the topic."""
    if not _TOPICS.passes():
        return publisher.get_num_connections() > 0
    return publisher.impl.has_connection(node)


class _PatientTransport(TCPROSTransport):
    """A connection to a service whose handshake takes a limited time, too.

    rospy limits only the time to connect, which the service's kernel does for a process that hangs.
    """

    def __init__(self, protocol: Any, name: str, patience: float) -> None:
        super().__init__(protocol, name)
        self._patience = patience

    def read_header(self) -> None:
        """Read the service's header; OSError if it does not come in time."""
        sock = self.socket
        _limit_reading(sock, self._patience)
        super().read_header()
        _limit_reading(sock, 0.0)


def _limit_reading(sock: socket.socket, seconds: float) -> None:
    """Limit the time that a read waits; 0: not at all. rospy would undo `settimeout`."""
    whole = int(seconds)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO,
                    struct.pack('ll', whole, int((seconds - whole) * 1e6)))


def connected_service(name: str, service_class: Any, patience: float) -> rospy.ServiceProxy:
    """Return a proxy that is connected, so that its request is sent at once.

    rospy's proxy asks the master and connects when it is called. If they hang, it sends the request
    as soon as they answer, and the robot would move when nobody expects it any more.

    Args:
        patience: s for the service to be connected, and again for its header.

    Raises:
        rosgraph.MasterError: the service does not exist.
        OSError: the master does not answer.
        rospy.TransportInitError: the service does not answer.
    """
    uri = rosgraph.Master(rospy.get_name()).lookupService(name)
    proxy = rospy.ServiceProxy(name, service_class)
    if _SERVICES.passes():
        proxy.transport = _PatientTransport(proxy.protocol, proxy.resolved_name, patience)
        try:
            proxy.transport.connect(*rospy.parse_rosrpc_uri(uri), uri, timeout=patience)
        except rospy.TransportInitError:
            proxy.close()
            raise
    return proxy
