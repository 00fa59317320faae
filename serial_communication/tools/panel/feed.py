"""What the pages see of the bridge: values, links, log lines and frames.

rospy's threads keep the latest packed message of each topic; the IO loop unpacks those, at the
rate of the updates. Topics are subscribed to in the worker's thread, so that the IO loop never
waits for the master.
"""
import math
import time
from collections import deque
from typing import Any, Deque, Dict, List, Optional, Tuple

import rospy
from rosgraph_msgs.msg import Log

from serial_communication.msg import SerialMsg

from ...ros.background import LatestWorker
from ..watch.state import BridgeState
from ..watch.topics import SERIAL_MSG, BridgeTopic, FieldValue
from ..watch.watcher import Watcher, unpack
from .news import News

FRAMES = 'frames'       # the group of `news` that only pages which show the wire are told
_FIRST_ANSWER = 1.5     # s that master and bridge have to answer after a page was opened
_MOST = 100             # frames and log lines that are kept
_MOST_BYTES = 300       # of a frame that are shown; those of the built-in boards are shorter
_MOST_TEXT = 500        # characters of a text that are shown
_MOST_VALUE = 20000     # … of a value in /diagnostics; one has the values of all settings
_MOST_FIELDS = 24       # of a topic; covariances are no news for people
_MOST_INTEGER = 2 ** 53     # a browser rounds larger integers


class Feed:
    """Observes one bridge while a page is open, and tells `news` of it."""

    def __init__(self, bridge: BridgeState, worker: LatestWorker, news: News) -> None:
        self._bridge = bridge
        self._worker = worker
        self._news = news
        self._wanted = False, False     # see `want`
        self._since = 0.0               # when it became active
        self._watcher: Optional[Watcher] = None
        self._log: Any = None           # subscriber, while there is a watcher
        self._latest: Dict[str, Tuple[BridgeTopic, bytes, float]] = {}
        self._frames: Deque[bytes] = deque(maxlen=_MOST)
        self._lines: Deque[List[Any]] = deque(maxlen=_MOST)
        self._fields: Dict[str, List[Any]] = {}      # of each topic, as `_field`
        news.tell('state', 'node', bridge.node)

    def want(self, active: bool, wire: bool, now: float) -> None:
        """Subscribe while a page is open (`active`), to serial_msg while one shows the `wire`."""
        if (active, wire) != self._wanted:
            if active and not self._wanted[0]:
                self._since = now
            self._wanted = active, wire
            self._worker.submit(self._register)

    def _register(self) -> None:
        active = self._wanted[0]
        if active and self._watcher:
            self._watcher.subscribe()
        elif active:
            self._log = rospy.Subscriber('/rosout_agg', Log, self._on_log, queue_size=100)
            self._watcher = Watcher(self._bridge, self._wants, self._on_message)
            self._watcher.start()
        elif self._watcher:
            self._watcher.stop()
            self._watcher = None
            self._log.unregister()

    def _wants(self, topic: BridgeTopic) -> bool:
        return self._wanted[1] or topic.name != SERIAL_MSG

    def _on_message(self, topic: BridgeTopic, packed: bytes, at: float) -> None:
        if topic.name == SERIAL_MSG:
            self._frames.append(packed)
        else:
            self._latest[topic.name] = topic, packed, at

    def _on_log(self, line: Log) -> None:
        if line.name == self._bridge.node:
            self._lines.append([round(time.monotonic(), 3), line.level, line.msg[:_MOST_TEXT]])

    def update(self, now: float) -> None:
        """Tell `news` what has changed since the last call."""
        tell, bridge = self._news.tell, self._bridge
        # While master and bridge have time to answer, there is no trouble yet.
        tell('state', 'trouble', bridge.trouble(now) if now - self._since > _FIRST_ANSWER else '')
        for name in list(self._latest):
            topic, packed, at = self._latest.pop(name)
            values = self._values(topic, packed)
            self._fields[name] = [_field(each) for each in values]
            tell('samples', name, [round(at, 3), *map(json_value, values)])
        tell('state', 'topics', {
            each.topic.name: {'type': each.topic.type, 'fields': self._fields.get(each.topic.name),
                              'limit': _rounded(each.stale_after())}
            for each in bridge.topics
            if each.topic.name != SERIAL_MSG and (each.count or not each.topic.optional)})
        for name, link in bridge.links.items():
            tell('links', name, link and {
                'at': round(link.at, 3), 'level': link.level, 'summary': link.summary[:_MOST_TEXT],
                'values': {key[:_MOST_TEXT]: value[:_MOST_VALUE]
                           for key, value in link.values.items()}})
        tell('state', 'titles', {board.name: board.title for board in bridge.boards})
        for _ in range(len(self._lines)):
            self._news.add('log', self._lines.popleft(), _MOST)
        for _ in range(len(self._frames)):
            self._news.add(FRAMES, _frame(self._frames.popleft()), _MOST)

    def _values(self, topic: BridgeTopic, packed: bytes) -> List[FieldValue]:
        """The values of a message; what is wrong, if its type is of another version than here."""
        try:
            return [each for each in topic.values(unpack(topic, packed))
                    if 'covariance' not in each.name][:_MOST_FIELDS]
        except Exception as error:  # pylint: disable=broad-except
            return [FieldValue('trouble', f'the message cannot be read: {error}')]


def _frame(packed: bytes) -> List[Any]:
    """[stamp, link, direction, text, error, bytes in hex] of one SerialMsg."""
    each = SerialMsg().deserialize(packed)
    return [round(each.header.stamp.to_sec(), 4), each.link, each.direction, each.text,
            each.error, bytes(each.frame[:_MOST_BYTES]).hex()]


def _field(each: FieldValue) -> List[Any]:
    """[name, unit, digits, low, high]."""
    return [each.name, each.unit, each.digits, _rounded(each.low, 6), _rounded(each.high, 6)]


def _rounded(number: Optional[float], digits: int = 1) -> Optional[float]:
    return None if number is None or not math.isfinite(number) else round(number, digits)


def json_value(value: FieldValue) -> Any:
    """The value for strict JSON: a number with few digits, or a text if JSON has no such number."""
    number = value.value
    if isinstance(number, str):
        return number[:_MOST_TEXT]
    if not isinstance(number, float):
        return number if abs(number) <= _MOST_INTEGER else str(number)
    return float(f'{number:.7g}') if math.isfinite(number) else str(number)
