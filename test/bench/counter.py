"""A subscriber that only counts: a child process that reads TCPROS without rospy.

A rospy subscriber gives up long before a fast publisher does. This one costs about what a C++
subscriber costs, so that what the bench finds lost was lost by the node.
"""
import selectors
import socket
import struct
import threading
import xmlrpc.client
from typing import Any, Dict, List, Set

import rosgraph
from diagnostic_msgs.msg import DiagnosticArray

from .child import serve

_ID = '/counter'
_LENGTH = struct.Struct('<I')


class Counter:
    """Counts the messages of a node's topics."""

    def __init__(self) -> None:
        self._counts: Dict[str, int] = {}
        self._waiting: Set[str] = set()           # topics whose publisher has not answered yet
        self._latest: Dict[str, bytes] = {}       # of the diagnostics, by the link's name
        self._selector = selectors.DefaultSelector()
        self._wake, self._woken = socket.socketpair()
        self._selector.register(self._woken, selectors.EVENT_READ, None)
        threading.Thread(target=self._run, daemon=True).start()

    def connect(self, node: str, topics: List[str]) -> List[str]:
        """Subscribe to these topics of a node; returns those that it does not have (yet)."""
        try:
            api = xmlrpc.client.ServerProxy(rosgraph.Master(_ID).lookupNode(node))
            protocols = {topic: api.requestTopic(_ID, topic, [['TCPROS']])[2] for topic in topics}
        except (OSError, rosgraph.MasterException):     # not there, or still the one before it
            return topics
        missing = []
        for topic, protocol in protocols.items():
            if not protocol:
                missing.append(topic)
                continue
            self._counts[topic] = 0
            self._waiting.add(topic)
            connection = socket.create_connection(protocol[1:3])
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
            fields = [f'{key}={value}'.encode() for key, value in (
                ('callerid', _ID), ('topic', topic), ('md5sum', '*'), ('type', '*'),
                ('tcp_nodelay', '1'))]
            header = b''.join(_LENGTH.pack(len(field)) + field for field in fields)
            connection.sendall(_LENGTH.pack(len(header)) + header)
            self._selector.register(connection, selectors.EVENT_READ, [topic, b'', True])
        self._wake.send(b'.')
        return missing

    def waiting(self) -> List[str]:
        """The topics whose publisher has not answered yet."""
        return sorted(self._waiting)

    def begin(self) -> bool:
        """Count from 0."""
        self._counts.update(dict.fromkeys(self._counts, 0))
        return True

    def collect(self) -> Dict[str, int]:
        """Messages by topic since `begin`."""
        return self._counts

    def diagnostics(self) -> Dict[str, Dict[str, str]]:
        """The latest values of each link, by its name."""
        links = {}
        for name, data in list(self._latest.items()):
            status = DiagnosticArray().deserialize(data).status[0]
            links[name] = {value.key: value.value for value in status.values}
        return links

    def _run(self) -> None:
        while True:
            for key, _ in self._selector.select():
                try:
                    data = key.fileobj.recv(1 << 18)
                except OSError:
                    data = b''
                if key.data is None:
                    continue
                if not data:
                    self._selector.unregister(key.fileobj)
                    key.fileobj.close()
                    continue
                self._take(key.data, data)

    def _take(self, state: List[Any], data: bytes) -> None:
        topic, rest, shaking_hands = state
        data = rest + data
        at, size, count = 0, len(data), 0
        while size - at >= 4:
            end = at + 4 + _LENGTH.unpack_from(data, at)[0]
            if end > size:
                break
            if shaking_hands:
                shaking_hands = state[2] = False
                self._waiting.discard(topic)
            else:
                count += 1
                if topic.endswith('/diagnostics'):
                    message = data[at + 4:end]
                    name = DiagnosticArray().deserialize(message).status[0].name
                    self._latest[name] = message
            at = end
        state[1] = data[at:]
        self._counts[topic] += count


def main() -> None:
    """counter."""
    counter = Counter()
    serve(connect=counter.connect, waiting=counter.waiting, begin=counter.begin,
          collect=counter.collect, diagnostics=counter.diagnostics)


if __name__ == '__main__':
    main()
