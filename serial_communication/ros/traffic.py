"""Publishes serial_msg: every frame of every link, while the topic has subscribers."""
import logging
import queue
import threading
from typing import Any, Callable, Iterable, Tuple

import rospy

from serial_communication.msg import SerialMsg

from ..framing.stream import Frame
from ..link.link import Link
from ..link.sparing_log import SparingLog
from .diagnostics import log_fault
from .publishing import publisher, wanted

_QUEUED = 2000   # frames that may wait for the thread; newer ones are dropped


class Traffic(rospy.SubscribeListener):
    """Publishes from a separate thread, so that subscribers do not slow down the links.

    Without subscribers, the links do not pass their frames on at all.
    """

    def __init__(self, links: Iterable[Link], logger: logging.Logger) -> None:
        super().__init__()
        self._lock = threading.Lock()
        self._log = SparingLog('serial_msg', logger)
        self._links = {link.name: link for link in links}
        # put() never blocks.
        self._queue: 'queue.SimpleQueue[Tuple[str, int, Frame, int]]' = queue.SimpleQueue()
        threading.Thread(target=self._run, name='serial_msg', daemon=True).start()
        self._topic: Any = None      # rospy may call the listener before it has returned this
        self._topic = publisher('serial_msg', SerialMsg, subscriber_listener=self)
        self._update()     # rospy adds the listener after others may have subscribed

    def peer_subscribe(self, topic_name: str, topic_publish: Callable,
                       peer_publish: Callable) -> None:
        """Pass on the frames of all links; called by rospy."""
        self._update()

    def peer_unsubscribe(self, topic_name: str, num_peers: int) -> None:
        """Stop that if there is no subscriber left; called by rospy."""
        self._update()

    def _update(self) -> None:
        is_wanted = self._is_wanted()    # num_peers is counted before others may have subscribed
        while True:
            with self._lock:
                for link in self._links.values():
                    link.traffic.tap = self._enqueue if is_wanted else None
            # Not with the lock: this takes one of rospy, with which another thread may come here.
            before, is_wanted = is_wanted, self._is_wanted()
            if is_wanted == before:
                return

    def _is_wanted(self) -> bool:
        return self._topic is not None and wanted(self._topic)

    def _enqueue(self, link: str, direction: int, frame: Frame) -> None:
        if self._queue.qsize() < _QUEUED:
            self._queue.put((link, direction, frame, self._links[link].reopening.count))

    def _run(self) -> None:
        while True:
            try:
                self._publish(*self._queue.get())
            except Exception as error:  # pylint: disable=broad-except
                log_fault(self._log, error)

    def _publish(self, link: str, direction: int, frame: Frame, connection: int) -> None:
        message = SerialMsg(link=link, direction=direction, type=frame.type,
                            command=frame.number, data=frame.data, frame=frame.raw,
                            text=frame.text, error=frame.trouble)
        message.header.stamp = frame.stamp or rospy.Time.now()
        # A reader that counts lost frames by SEQ has to know when the port was opened again, since
        # frames missed in between were not lost on the line. frame_id is free for this; another
        # field would change the message's type, and older bags could not be read.
        message.header.frame_id = f'connection {connection}'
        self._topic.publish(message)
