"""Publishing without a thread hop.

rospy hands every message for every subscriber to a thread of that connection, so that a slow
subscriber holds up nobody. Waking those threads costs more than sending. Here a message goes
into the subscriber's socket at once, without waiting; rospy's own queue and thread take over
for good on the connection whose socket is full, and only there.
"""
import socket
import threading

import rospy.topics
from rospy.impl.tcpros_pubsub import QueuedConnection
from rospy.impl.transport import Transport
from rospy.exceptions import TransportTerminated


class DirectConnection(QueuedConnection):
    """A connection to one subscriber; `write_data` never waits."""

    def __init__(self, connection: Transport, queue_size: int) -> None:
        # Not QueuedConnection's own: that one starts the thread.
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


def install() -> None:
    """Use it for every publisher of this process from now on."""
    rospy.topics.QueuedConnection = DirectConnection
