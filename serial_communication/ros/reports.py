"""What the node publishes of every link: serial_msg and /diagnostics."""
import queue
import threading
import time
from typing import Any, Iterable, Tuple

import rospy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from std_msgs.msg import Header

from serial_communication.msg import SerialMsg

from ..framing.stream import Frame
from ..link.link import Link
from .background import repeat
from .publishing import has_subscribers, publisher

_QUEUED = 2000   # frames that may wait for the thread; newer ones are dropped
_PERIOD = 1.0    # s


class Traffic(rospy.SubscribeListener):
    """Publishes serial_msg from a separate thread, so that subscribers do not slow down the links.

    Without subscribers, the links do not pass their frames on at all.
    """

    def __init__(self, links: Iterable[Link]) -> None:
        super().__init__()
        self._links = list(links)
        # put() never blocks.
        self._queue: 'queue.SimpleQueue[Tuple[str, int, Frame]]' = queue.SimpleQueue()
        self._lock = threading.Lock()
        with self._lock:        # rospy may call `peer_subscribe` at once
            self._topic = publisher('serial_msg', SerialMsg, subscriber_listener=self)
        repeat('serial_msg', self._publish)
        self.peer_subscribe()   # others may have subscribed before rospy had the listener

    def peer_subscribe(self, *_: Any) -> None:
        """Called by rospy."""
        with self._lock:
            tap = self._enqueue if has_subscribers(self._topic) else None
            for link in self._links:
                link.session.tap = tap

    peer_unsubscribe = peer_subscribe

    def _enqueue(self, link: str, direction: int, frame: Frame) -> None:
        if self._queue.qsize() < _QUEUED:
            self._queue.put((link, direction, frame))

    def _publish(self) -> None:
        link, direction, frame = self._queue.get()
        self._topic.publish(Header(0, frame.stamp or rospy.Time.now(), ''), link, direction,
                            frame.type, frame.number, frame.data, frame.raw, frame.text,
                            frame.trouble)


def publish_diagnostics(links: Iterable[Link]) -> None:
    """Publish the status of each link from now on, once a second by the monotonic clock."""
    topic = publisher('/diagnostics', DiagnosticArray)

    def publish() -> None:
        time.sleep(_PERIOD)
        for link in links:
            level, summary, values = link.report(link.now())
            topic.publish(Header(0, rospy.Time.now(), ''), [DiagnosticStatus(
                level, f'{rospy.get_name()[1:]}: {link.name} link', summary, link.port.url,
                [KeyValue(key, str(value)) for key, value in values])])

    repeat('diagnostics', publish)
