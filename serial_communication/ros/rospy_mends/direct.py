"""Publishing without a thread hop.

rospy hands every message for every subscriber to a thread of that connection, so that a slow
subscriber holds up nobody. Waking those threads costs more than sending. Here a message goes
into the subscriber's socket at once, without waiting. What a full socket does not take is kept in
a queue, which one thread for all slow subscribers sends on as their sockets take more.

That thread is there from the start: a link's thread, which publishes, must not start one, since
where no memory is left that may never return.

This is written against private parts of rospy: see private_parts.py.
"""
import logging
import select
import socket
import threading
import time
from collections import deque
from typing import Deque, Dict, Union

import rospy.topics
from rospy.exceptions import TransportTerminated
from rospy.impl.tcpros_base import TCPROSTransport
from rospy.impl.transport import Transport

from .private_parts import are_known, names

_PRIVATE = {'_closed_connection_callback', '_cond_data_available', '_connection', '_error',
            '_lock', '_queue', '_queue_size', '_run', '_thread'}    # all of QueuedConnection
_AGAIN = 0.1       # s until the thread goes on after a fault
_OF_A_TRANSPORT = {'done', 'socket', 'stat_bytes', 'stat_num_msg'}


class DirectConnection(rospy.topics.QueuedConnection):
    """A connection to one subscriber; `write_data` never waits."""

    def __init__(self, connection: Transport, queue_size: int) -> None:
        # Without super().__init__(), since that starts a thread.
        self._connection = connection
        self._queue_size = queue_size
        self._lock = threading.Lock()
        self._rest = memoryview(b'')       # of a message that has left in part
        self._queue: Deque[bytes] = deque()     # messages behind it
        # Whether there are any: `_sender` sends them. Set by publishers, reset by its thread.
        self._is_slow = False
        self._fd = -1                      # while it is slow
        connection.set_cleanup_callback(self._closed_connection_callback)

    def write_data(self, data: bytes) -> bool:
        """Send one serialized message; rospy calls this under the publisher's lock."""
        connection = self._connection
        if self._is_slow and self._queued(data):
            return True
        try:
            sent = self._send(data)
            connection.stat_bytes += len(data)
            connection.stat_num_msg += 1
            if sent < len(data):
                self._rest = memoryview(data)[sent:]
                self._fd = connection.socket.fileno()
                self._is_slow = True
                _sender.take(self._fd, self)
        except (OSError, ValueError, AttributeError) as error:     # closed meanwhile
            connection.close()
            raise TransportTerminated(str(error)) from None
        return True

    def _queued(self, data: bytes) -> bool:
        """Leave it to the thread, unless that has just sent everything."""
        with self._lock:
            if not self._is_slow:
                return False
            if self._connection.done:
                raise TransportTerminated('the subscriber has gone')
            if 0 < self._queue_size <= len(self._queue):
                self._queue.popleft()
            self._queue.append(data)
        return True

    def _send(self, data: Union[bytes, memoryview]) -> int:
        """How many bytes of it the socket takes at once."""
        try:
            return self._connection.socket.send(data, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return 0

    def send_on(self) -> None:
        """In the thread: the socket takes more. One call for one message at most, so that no
        subscriber waits for another one."""
        try:
            with self._lock:
                if not self._rest:
                    self._rest = memoryview(self._queue.popleft())
                self._rest = self._rest[self._send(self._rest):]
                if not self._rest and not self._queue:
                    self._is_slow = False
                    _sender.leave(self._fd, self)
        except (OSError, AttributeError):
            self._connection.close()    # the publisher drops it at the next message

    def _closed_connection_callback(self, connection: Transport) -> None:
        _sender.leave(self._fd, self)


class _Sender:
    """The thread that sends on, for all slow subscribers."""

    def __init__(self) -> None:
        self._poll = select.epoll()
        self._slow: Dict[int, DirectConnection] = {}    # by the descriptors of their sockets

    def start(self) -> None:
        """Start the thread."""
        threading.Thread(target=self._run, name='slow subscribers', daemon=True).start()

    def take(self, fd: int, connection: DirectConnection) -> None:
        """Call its `send_on` whenever its socket takes more."""
        self._slow[fd] = connection
        self._poll.register(fd, select.EPOLLOUT)

    def leave(self, fd: int, connection: DirectConnection) -> None:
        """Call it no more, if it is called at all."""
        if self._slow.get(fd) is connection:    # the number may be another connection's by now
            del self._slow[fd]
            try:
                self._poll.unregister(fd)
            except (OSError, ValueError):
                pass    # closed: the kernel has forgotten it

    def _run(self) -> None:
        while True:
            try:
                for fd, _ in self._poll.poll():
                    connection = self._slow.get(fd)
                    if connection is not None:
                        connection.send_on()
            except Exception:  # pylint: disable=broad-except
                time.sleep(_AGAIN)      # no memory for the moment


_sender = _Sender()


def install(logger: logging.Logger) -> None:
    """Use it for every subscriber that comes from now on, if rospy is one that it fits."""
    if are_known(_is_as_expected, 'sends messages',
                 "they go through rospy's own threads, which takes more CPU", logger.warning):
        _sender.start()
        rospy.topics.QueuedConnection = DirectConnection


def _is_as_expected() -> bool:
    private = {name for name in names(vars(rospy.topics.QueuedConnection).values())
               if name.startswith('_') and not name.startswith('__')}
    return (private == _PRIVATE
            and _OF_A_TRANSPORT <= names([Transport.__init__, TCPROSTransport.__init__]))
