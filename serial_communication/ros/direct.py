"""Publishing from the calling thread.

rospy passes every message to a thread for each subscriber, so that a slow subscriber delays nobody
else. Waking these threads costs more than sending. Here a message is written to the subscriber's
socket at once, without blocking, and the thread sends only what the socket did not take.

This needs private parts of rospy. If their source is not known, rospy publishes as it does
everywhere.
"""
import hashlib
import inspect
import socket

import rospy.topics
from rospy.exceptions import TransportTerminated

# Of rospy 1.15.15 (Debian 12), 1.16.0 (Noetic) and 1.17.0 (Debian 13): see `install`.
_KNOWN = 'f2310bee02aa63eb'


class DirectConnection(rospy.topics.QueuedConnection):
    """A connection to one subscriber; `write_data` never blocks."""

    _rest = b''     # of a message that the socket took in part; while it is slow, others wait

    def write_data(self, data: bytes) -> bool:
        """Send one serialized message; rospy calls this under the publisher's lock."""
        connection = self._connection
        with self._lock:
            if connection.done:
                raise TransportTerminated('the subscriber has gone')
            if self._rest:
                if 0 < self._queue_size <= len(self._queue):
                    del self._queue[0]
                self._queue.append(data)
                return True
            try:
                sent = connection.socket.send(data, socket.MSG_DONTWAIT)
            except BlockingIOError:
                sent = 0
            except (OSError, AttributeError) as error:      # closed meanwhile
                raise TransportTerminated(str(error)) from None
            connection.stat_bytes += len(data)
            connection.stat_num_msg += 1
            self._rest = data[sent:]
            if self._rest:
                self._cond_data_available.notify()
        return True

    def _run(self) -> None:
        """Send the rest, then what waits. The thread that rospy starts for each subscriber."""
        connection = self._connection
        while not connection.done:
            with self._lock:
                while not self._rest and not connection.done:
                    self._cond_data_available.wait()
            try:
                connection.socket.sendall(self._rest)
            except (OSError, AttributeError):
                connection.close()      # the publisher drops it at the next message
                return
            with self._lock:
                self._rest = self._queue.pop(0) if self._queue else b''


def install() -> bool:
    """Patch rospy; affects later subscribers. Return False if the source of the parts that are
    replaced or relied on is not known."""
    try:
        queued, publisher = rospy.topics.QueuedConnection, rospy.topics._PublisherImpl
        parts = [*filter(inspect.isfunction, vars(queued).values()), publisher.add_connection,
                 publisher.publish]
        source = ''.join(map(inspect.getsource, parts))
    except (AttributeError, OSError):     # a part is missing, or installed without its source
        return False
    if hashlib.sha256(source.encode()).hexdigest()[:16] != _KNOWN:
        return False
    rospy.topics.QueuedConnection = DirectConnection
    return True
