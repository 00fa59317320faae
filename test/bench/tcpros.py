"""A subscriber that only counts messages: it reads TCPROS without rospy.

A rospy subscriber is much slower than a fast publisher. This one needs about as much CPU time as a
C++ subscriber, so that losses found by the bench are losses of the node.
"""
import selectors
import socket
import struct
import threading
import xmlrpc.client
from typing import Any, Dict, List, Set

import rosgraph

_ID = '/counter'
_LENGTH = struct.Struct('<I')


class Counter:
    """Counts the messages on topics of several nodes."""

    def __init__(self) -> None:
        self._counts: Dict[str, int] = {}
        self._waiting: Set[str] = set()       # topics whose publisher has not answered yet
        self._selector = selectors.DefaultSelector()
        threading.Thread(target=self._run, daemon=True).start()

    def connect(self, node: str, topics: List[str]) -> bool:
        """Subscribe to topics of a node; False if it does not publish all of them yet."""
        try:
            api = xmlrpc.client.ServerProxy(rosgraph.Master(_ID).lookupNode(node))
            protocols = {topic: api.requestTopic(_ID, topic, [['TCPROS']])[2] for topic in topics}
        except (OSError, rosgraph.MasterException):     # not running, or still the one before it
            return False
        if not all(protocols.values()):
            return False
        for topic, protocol in protocols.items():
            self._counts[topic] = 0
            self._waiting.add(topic)
            connection = socket.create_connection(protocol[1:3])
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
            fields = [f'{key}={value}'.encode() for key, value in (
                ('callerid', _ID), ('topic', topic), ('md5sum', '*'), ('type', '*'),
                ('tcp_nodelay', '1'))]
            header = b''.join(_LENGTH.pack(len(field)) + field for field in fields)
            connection.sendall(_LENGTH.pack(len(header)) + header)
            self._selector.register(connection, selectors.EVENT_READ, [topic, b''])
        return True

    def waiting(self) -> List[str]:
        """Return the topics whose publisher has not answered yet."""
        return sorted(self._waiting)

    def take(self) -> Dict[str, int]:
        """Return the number of messages by topic since the last call."""
        counts, self._counts = self._counts, dict.fromkeys(self._counts, 0)
        return counts

    def _run(self) -> None:
        while True:
            for key, _ in self._selector.select(0.1):
                try:
                    data = key.fileobj.recv(1 << 18)
                except OSError:
                    data = b''
                if data:
                    self._count(key.data, data)
                else:
                    self._selector.unregister(key.fileobj)
                    key.fileobj.close()

    def _count(self, state: List[Any], data: bytes) -> None:
        topic, rest = state
        data = rest + data
        at, count = 0, 0
        while len(data) - at >= 4:
            end = at + 4 + _LENGTH.unpack_from(data, at)[0]
            if end > len(data):
                break
            if topic in self._waiting:
                self._waiting.discard(topic)      # the first is the publisher's header
            else:
                count += 1
            at = end
        state[1] = data[at:]
        self._counts[topic] += count
