"""Accepts connections so that none of them can block the others.

rospy's accepting thread also reads each connection's header, and waits for it without a time limit.
It ends if it fails to accept a connection. So no subscriber and no caller would be served any more
after a port scan, after a peer of a dead node connects to this node, which reuses its port, or
after the node ran out of file descriptors.

Here the accepting thread waits for all connections at the same time. Each has 3 s to send its
header of up to 64 KB. There is no thread for each connection, since it might not start, and rospy's
handlers still run in one thread, one after the other, as they require.

rospy lets six connections wait to be accepted. The kernel ignores others, whose callers try again
after 1, 3 and 7 s. So a call from the time of a stall could arrive long after it, and look new.
Here as many may wait as the kernel allows.
"""
import selectors
import socket
import time
from typing import Any, Dict, Optional

from rosgraph.network import decode_ros_handshake_header
from rospy.impl import tcpros_base

from ...link.sparing_log import SparingLog
from .private_parts import Guard
from .shortage import PAUSE, advice

_PATIENCE = 3.0         # s for a complete header
_LONGEST = 64 << 10     # bytes of a header
_MOST_PENDING = 64      # connections without a complete header
_READ = 'read_ros_handshake_header'
_GUARD = Guard('rospy.impl.tcpros_base:TCPServer.run rospy.impl.tcpros_base:TCPServer.shutdown '
               'rospy.impl.tcpros_base:TCPROSServer._tcp_server_callback '
               'rospy.impl.tcpros_base:read_ros_handshake_header '
               'rosgraph.network:decode_ros_handshake_header', {'629e4c145bc4b9b0'},
               'accepts connections',
               'one that sends nothing may block the others')


class _PendingConnection:
    """A connection whose header has not been received completely."""

    def __init__(self, connection: socket.socket, address: Any) -> None:
        self.connection = connection
        self.address = address
        self.deadline = time.monotonic() + _PATIENCE
        self.header = bytearray()       # including its length, which comes first

    def read(self) -> bool:
        """Read what has arrived of the header, and nothing after it.

        Returns:
            Whether the header is complete.

        Raises:
            OSError: the connection has failed.
            ValueError: this is not a ROS header.
        """
        while True:
            missing = self._missing()
            if not missing:
                return True
            try:
                data = self.connection.recv(missing)
            except BlockingIOError:
                return False
            if not data:
                raise ValueError('it was closed before its header was complete')
            self.header += data

    def _missing(self) -> int:
        if len(self.header) < 4:
            return 4 - len(self.header)
        length = int.from_bytes(self.header[:4], 'little')
        if length > _LONGEST:
            raise ValueError(f'its header has {length} bytes; at most {_LONGEST} are accepted')
        return 4 + length - len(self.header)


class _Acceptor:
    """The loop that accepts connections for one `TCPServer`."""

    def __init__(self, server: Any, headers: Dict[socket.socket, bytes], log: SparingLog) -> None:
        self._server = server
        self._headers = headers
        self._log = log
        self._pending: Dict[_PendingConnection, None] = {}  # the oldest first
        self._selector = selectors.PollSelector()       # needs no file descriptor itself

    def run(self) -> None:
        """Accept connections until the server is shut down."""
        self._server.is_shutdown = False
        listener = self._server.server_sock
        try:
            listener.listen(socket.SOMAXCONN)
            listener.setblocking(False)
            self._selector.register(listener, selectors.EVENT_READ)
        except (OSError, ValueError):
            if listener.fileno() >= 0:
                raise
            return      # rospy has shut down before this thread ran
        while not self._server.is_shutdown:
            try:
                self._serve(listener)
            except Exception:  # pylint: disable=broad-except
                time.sleep(PAUSE)       # probably out of memory for the moment

    def _serve(self, listener: socket.socket) -> None:
        for key, _ in self._selector.select(self._until_next_deadline()):
            if key.fileobj is listener:
                self._accept(listener)
            elif key.data in self._pending:
                self._read(key.data)
        self._drop_expired()

    def _until_next_deadline(self) -> Optional[float]:
        for pending in self._pending:
            return max(0.0, pending.deadline - time.monotonic())
        return None

    def _accept(self, listener: socket.socket) -> None:
        try:
            connection, address = listener.accept()
        except (BlockingIOError, InterruptedError, ConnectionAbortedError):
            return
        except OSError as error:
            if not self._server.is_shutdown:
                self._log.warn('accept', advice(error))
                time.sleep(PAUSE)
            return
        connection.setblocking(False)
        if len(self._pending) >= _MOST_PENDING:
            self._drop(next(iter(self._pending)),
                       f'more than {_MOST_PENDING} connections are waiting to send their header')
        pending = _PendingConnection(connection, address)
        self._pending[pending] = None
        self._selector.register(connection, selectors.EVENT_READ, pending)
        self._read(pending)

    def _read(self, pending: _PendingConnection) -> None:
        try:
            if pending.read():
                self._hand_to_rospy(pending)
        except (OSError, ValueError) as error:
            self._drop(pending, str(error))

    def _hand_to_rospy(self, pending: _PendingConnection) -> None:
        self._forget(pending)
        connection = pending.connection
        connection.setblocking(True)    # as rospy expects it
        self._headers[connection] = bytes(pending.header)
        try:
            self._server.inbound_handler(connection, pending.address)
        except Exception as error:  # pylint: disable=broad-except
            # One connection's error must not end the loop for all others.
            self._close(pending, str(error))
        finally:
            self._headers.pop(connection, None)

    def _drop_expired(self) -> None:
        now = time.monotonic()
        for pending in [each for each in self._pending if each.deadline <= now]:
            self._drop(pending, f'it sent no complete header within {_PATIENCE:g} s')

    def _drop(self, pending: _PendingConnection, why: str) -> None:
        self._forget(pending)
        self._close(pending, why)

    def _forget(self, pending: _PendingConnection) -> None:
        del self._pending[pending]
        self._selector.unregister(pending.connection)

    def _close(self, pending: _PendingConnection, why: str) -> None:
        pending.connection.close()
        self._log.warn('refused', f'the connection from {pending.address[0]} was closed: {why}')


def install(log: SparingLog) -> None:
    """Patch rospy, if its source is known; call this before anybody can connect."""
    if not _GUARD.passes(log.always_warn):
        return
    read = getattr(tcpros_base, _READ)
    headers: Dict[socket.socket, bytes] = {}

    def header_of(connection: socket.socket, *arguments: Any) -> Any:
        header = headers.pop(connection, None)
        if header is None:      # this process made the connection
            return read(connection, *arguments)
        return decode_ros_handshake_header(header)

    setattr(tcpros_base, _READ, header_of)
    tcpros_base.TCPServer.run = lambda server: _Acceptor(server, headers, log).run()
