"""Publishers that do what rospy's cannot: latch any message, and have connections of one name.
They use ROS's protocols with the master and the subscribers."""
import io
import socket
import struct
import threading
from xmlrpc.server import SimpleXMLRPCServer

import rosgraph

from boards import until


class FakePublisher:
    """A publisher of one topic.

    Args:
        name: of its node.
        latching: whether its header says that it latches.
        latched: the first message on each connection.
    """

    def __init__(self, name, topic, message_class, latching=False, latched=None):
        self.connections = []       # the oldest first
        self._name, self._topic, self._class = name, topic, message_class
        self._latched = latched
        self._header = {'callerid': name, 'topic': topic, 'type': message_class._type,
                        'md5sum': message_class._md5sum, 'latching': '1' if latching else '0',
                        'message_definition': message_class._full_text}
        self._listener = socket.create_server(('localhost', 0))
        self._node = SimpleXMLRPCServer(('localhost', 0), logRequests=False, allow_none=True)
        self._node.register_function(self._request, 'requestTopic')
        self._node.register_function(lambda *_: (1, '', 0), 'shutdown')
        for serve in (self._accept, self._node.serve_forever):
            threading.Thread(target=serve, name=name, daemon=True).start()
        self._uri = 'http://localhost:%d' % self._node.server_address[1]
        self._master = rosgraph.Master(name)
        self._master.registerPublisher(self._topic, self._class._type, self._uri)

    def connected(self):
        """Wait for a connection, and return self."""
        until(lambda: self.connections, '%s is connected' % self._name)
        return self

    def say(self, message):
        """Send a message on its newest connection; wait for the first one."""
        self.connected().connections[-1].sendall(_packed(message))

    def close(self):
        """Unregister it and close its connections."""
        self._master.unregisterPublisher(self._topic, self._uri)
        self._listener.close()
        self._node.shutdown()
        self._node.server_close()
        for connection in self.connections:
            connection.close()

    def _request(self, _caller, _topic, _protocols):
        return 1, '', ['TCPROS', 'localhost', self._listener.getsockname()[1]]

    def _accept(self):
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            rosgraph.network.read_ros_handshake_header(connection, io.BytesIO(), 65536)
            header = b''.join(struct.pack('<I', len(field)) + field for field in (
                ('%s=%s' % item).encode() for item in self._header.items()))
            connection.sendall(struct.pack('<I', len(header)) + header)
            if self._latched is not None:
                connection.sendall(_packed(self._latched))
            self.connections.append(connection)


def _packed(message):
    data = io.BytesIO()
    message.serialize(data)
    return struct.pack('<I', len(data.getvalue())) + data.getvalue()
