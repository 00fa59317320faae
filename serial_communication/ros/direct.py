"""Publishing without a thread hop.

rospy hands every message for every subscriber to a thread of that connection, so that a slow
subscriber holds up nobody. Waking those threads costs more than sending. Here a message goes
into the subscriber's socket at once, without waiting; rospy's own queue and thread take over
for good on the connection whose socket is full, and only there.

This is written against private parts of rospy, as they are in 1.15.15 (Debian 12) and 1.16.0
(Noetic). `install` looks whether they are the same, and leaves a rospy that differs as it is.
"""
import inspect
import logging
import socket
import threading
from typing import Any, Iterable, Set

import rospy.topics
from rospy.exceptions import TransportTerminated
from rospy.impl.tcpros_base import TCPROSTransport
from rospy.impl.transport import Transport

_PRIVATE = {'_closed_connection_callback', '_cond_data_available', '_connection', '_error',
            '_lock', '_queue', '_queue_size', '_run', '_thread'}    # all of QueuedConnection
_OF_A_TRANSPORT = {'socket', 'stat_bytes', 'stat_num_msg'}


class DirectConnection(rospy.topics.QueuedConnection):
    """A connection to one subscriber; `write_data` never waits."""

    def __init__(self, connection: Transport, queue_size: int) -> None:
        # Without super().__init__(), since that starts the thread. Once the socket is full it
        # would be of no use either: the rest of a message that has left in part would have to
        # wait in its queue, where a newer message may drop it.
        self._connection = connection
        self._queue_size = queue_size
        self._lock = threading.Lock()
        self._cond_data_available = threading.Condition(self._lock)
        self._queue = []
        self._error = None
        self._thread = None
        self._connection.set_cleanup_callback(self._closed_connection_callback)

    def write_data(self, data: bytes) -> bool:
        """Send one serialized message; rospy calls this under the publisher's lock."""
        if self._thread is not None:
            return super().write_data(data)
        connection = self._connection
        try:
            sent = connection.socket.send(data, socket.MSG_DONTWAIT)
        except BlockingIOError:
            sent = 0
        except (OSError, AttributeError) as error:    # AttributeError: closed meanwhile
            connection.close()
            raise TransportTerminated(str(error)) from None
        connection.stat_bytes += len(data)
        connection.stat_num_msg += 1
        if sent < len(data):
            self._thread = threading.Thread(target=self._send_on, args=(data[sent:],),
                                            name='slow subscriber', daemon=True)
            self._thread.start()
        return True

    def _send_on(self, rest: bytes) -> None:
        try:
            self._connection.write_data(rest)
        except Exception as error:  # pylint: disable=broad-except
            self._error = error     # as QueuedConnection does: raised at the next message
        self._run()


def install(logger: logging.Logger) -> None:
    """Use it for every subscriber that comes from now on, if rospy is one that it fits."""
    private = {name for name in _names(vars(rospy.topics.QueuedConnection).values())
               if name.startswith('_') and not name.startswith('__')}
    if private == _PRIVATE \
            and _OF_A_TRANSPORT <= _names([Transport.__init__, TCPROSTransport.__init__]):
        rospy.topics.QueuedConnection = DirectConnection
    else:
        logger.warning('this rospy sends messages in another way than 1.15.15 and 1.16.0: '
                       "they go through rospy's own threads, which takes more CPU")


def _names(members: Iterable[Any]) -> Set[str]:
    """What the functions among these use."""
    return {name for member in members if inspect.isfunction(member)
            for name in member.__code__.co_names}
