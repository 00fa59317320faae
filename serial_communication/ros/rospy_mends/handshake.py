"""Whoever connects to this node is served at once, whatever others do that connect.

rospy reads what a connection begins with in the thread that accepts all the others, and waits
for it for ever; and that thread ends at the first failure to accept one. After a port scanner,
after the master's call for a dead node whose port this one has been given, or once the node was
out of file descriptors, no subscriber and no caller would be served any more.

Here that thread waits for all of them at the same time: each has 3 s for its header, which may
have 64 KB. It needs no thread for each, which might not start, and rospy's handlers still run in
one thread, one after the other, as they are written for.

This is written against private parts of rospy: see private_parts.py.
"""
import selectors
import socket
import time
from typing import Any, Dict, Optional

from rosgraph.network import decode_ros_handshake_header
from rospy.impl import tcpros_base

from ...link.sparing_log import SparingLog
from .private_parts import are_known, names
from .shortage import PAUSE, advice

_PATIENCE = 3.0         # s for a whole header
_LONGEST = 64 << 10     # bytes of a header
_AT_ONCE = 64           # connections that wait for their header's end
_READ = 'read_ros_handshake_header'
_RUN = {'is_shutdown', 'server_sock', 'accept', 'inbound_handler', 'ROSInternalException',
        '__class__', '__name__', 'socket', 'timeout', 'ConnectionAbortedError', 'IOError', 'args',
        'errno', 'EINTR', 'error', 'traceback', 'print_exc', 'logwarn', 'logdebug',
        'port'}         # all that TCPServer.run uses


class _Newcomer:
    """A connection whose header has not been received completely."""

    def __init__(self, connection: socket.socket, address: Any) -> None:
        self.connection = connection
        self.address = address
        self.deadline = time.monotonic() + _PATIENCE
        self.header = bytearray()       # with its length, which comes first

    def read(self) -> bool:
        """Take what has arrived, and nothing behind the header; whether that is complete.

        Raises:
            OSError: the connection is of no use.
            ValueError: this is no header.
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
            raise ValueError(f'a header of {length} bytes, {_LONGEST} at most: this is not ROS')
        return 4 + length - len(self.header)


class _Door:
    """The loop that takes connections for one `TCPServer`."""

    def __init__(self, server: Any, headers: Dict[socket.socket, bytes], log: SparingLog) -> None:
        self._server = server
        self._headers = headers
        self._log = log
        self._newcomers: Dict[_Newcomer, None] = {}     # the oldest first
        self._selector = selectors.PollSelector()       # which needs no descriptor itself

    def run(self) -> None:
        """Until the server is shut down."""
        self._server.is_shutdown = False
        listener = self._server.server_sock
        listener.setblocking(False)
        self._selector.register(listener, selectors.EVENT_READ)
        while not self._server.is_shutdown:
            for key, _ in self._selector.select(self._until_the_next_is_late()):
                if key.fileobj is listener:
                    self._accept(listener)
                elif key.data in self._newcomers:
                    self._read(key.data)
            self._drop_the_late()

    def _until_the_next_is_late(self) -> Optional[float]:
        for newcomer in self._newcomers:
            return max(0.0, newcomer.deadline - time.monotonic())
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
        if len(self._newcomers) >= _AT_ONCE:
            self._drop(next(iter(self._newcomers)), 'too many others connect at the same time')
        newcomer = _Newcomer(connection, address)
        self._newcomers[newcomer] = None
        self._selector.register(connection, selectors.EVENT_READ, newcomer)
        self._read(newcomer)

    def _read(self, newcomer: _Newcomer) -> None:
        try:
            if newcomer.read():
                self._let_in(newcomer)
        except (OSError, ValueError) as error:
            self._drop(newcomer, str(error))

    def _let_in(self, newcomer: _Newcomer) -> None:
        """Hand it to rospy, which writes and reads it as a blocking one."""
        self._forget(newcomer)
        connection = newcomer.connection
        connection.setblocking(True)
        self._headers[connection] = bytes(newcomer.header)
        try:
            self._server.inbound_handler(connection, newcomer.address)
        except Exception as error:  # pylint: disable=broad-except
            # Whatever one connection raises must not shut out all the others.
            self._refuse(newcomer, str(error))
        finally:
            self._headers.pop(connection, None)

    def _drop_the_late(self) -> None:
        now = time.monotonic()
        for newcomer in [each for each in self._newcomers if each.deadline <= now]:
            self._drop(newcomer, f'no complete header within {_PATIENCE:g} s')

    def _drop(self, newcomer: _Newcomer, why: str) -> None:
        self._forget(newcomer)
        self._refuse(newcomer, why)

    def _forget(self, newcomer: _Newcomer) -> None:
        del self._newcomers[newcomer]
        self._selector.unregister(newcomer.connection)

    def _refuse(self, newcomer: _Newcomer, why: str) -> None:
        newcomer.connection.close()
        self._log.warn('refused', f'the connection from {newcomer.address[0]} was closed: {why}')


def _is_as_expected() -> bool:
    return (hasattr(tcpros_base, _READ) and names([tcpros_base.TCPServer.run]) == _RUN
            and _READ in names([tcpros_base.TCPROSServer._tcp_server_callback]))


def install(log: SparingLog) -> None:
    """Have it so; to be called before anybody can connect."""
    if not are_known(_is_as_expected, 'takes connections',
                     'one that says nothing may hold up the others', log.always_warn):
        return
    read = getattr(tcpros_base, _READ)
    headers: Dict[socket.socket, bytes] = {}

    def header_of(connection: socket.socket, *arguments: Any) -> Any:
        header = headers.pop(connection, None)
        if header is None:      # a connection that this process has made
            return read(connection, *arguments)
        return decode_ros_handshake_header(header)

    setattr(tcpros_base, _READ, header_of)
    tcpros_base.TCPServer.run = lambda server: _Door(server, headers, log).run()
