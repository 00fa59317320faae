"""What the page is told of the bridge: rows of numbers, words, links and frames.

Messages are taken as they come and unpacked on the IO loop, once a tick, all of them, so that a
plot shows every one. Everything but `_keep` and `_hear` (rospy's threads) and `_register` (the
registrar's) runs on the IO loop, which never waits for the master.
"""
import math
import time
from collections import deque
from itertools import islice
from typing import Any, Deque, Dict, Iterable, List, Optional, Set, Tuple

import rospy
from rosgraph_msgs.msg import Log

from ..watch.state import BridgeState, LinkState, TopicState
from ..watch.topics import DIAGNOSTICS, SERIAL_MSG, TABLE, BridgeTopic, FieldValue
from ..watch.watcher import Watcher
from .registrar import Registrar
from .wire import Wire

HISTORY = 600.0         # s that a topic's rows, and a link's errors, are kept for
_SPARSE = 0.5           # s between the messages of a topic whose rows are kept
_FIRST_WORD = 1.5       # s that master and bridge have to answer, once somebody looks
_MOST_WAITING = 2000    # messages that wait for the IO loop; older ones are left out
_MOST_FRAMES = 100      # that one update carries: 2500 a second
_MOST_LINES = 100       # of the log that are kept
_LONGEST = 500          # characters of a text that are shown
_MOST_KEYS = 200        # of a link's values
_MOST_DIGITS = 2 ** 53  # beyond it a browser rounds integers


class _Shown:
    """What the page knows of one topic."""

    def __init__(self) -> None:
        self.rows: List[List[Any]] = []      # that the page has not been told yet
        self.message: Any = None             # the latest
        self.trouble = ''                    # why there is none
        self._shape: Optional[Tuple] = None  # of each value of a row: what it is
        self._changed = False                # the shape, since the last update
        self._last: Optional[List[Any]] = None
        self._history: Deque[List[Any]] = deque()

    def add(self, at: float, values: Iterable[FieldValue]) -> None:
        """Another message has come."""
        values = tuple(values)
        shape = tuple((each.name, each.unit, each.digits, _limit(each.low), _limit(each.high))
                      for each in values)
        if shape != self._shape:
            if self._shape and [each[0] for each in shape] != [each[0] for each in self._shape]:
                self._history.clear()
                self.rows.clear()
            self._shape, self._changed = shape, True
        row = [round(at, 4), *(plain(each) for each in values)]
        # Only what comes slowly is kept for those who open the page later: minutes of what comes
        # a hundred times a second would be megabytes.
        if self._last and at - self._last[0] >= _SPARSE:
            self._history.append(row)
            while at - self._history[0][0] > HISTORY:
                self._history.popleft()
        self._last = row
        self.rows.append(row)

    def news(self, state: Optional[TopicState]) -> Dict[str, Any]:
        """What has come since the last time."""
        told = self._tell(state, self.rows, self._changed)
        self.rows, self._changed = [], False
        return told

    def everything(self, state: Optional[TopicState], now: float) -> Dict[str, Any]:
        """All that is known."""
        rows = [row for row in self._history if now - row[0] <= HISTORY]
        if self._last and (not rows or rows[-1] is not self._last):
            rows.append(self._last)
        return self._tell(state, rows, True)

    def _tell(self, state: Optional[TopicState], rows: List[Any],
              fields: bool) -> Dict[str, Any]:
        limit = _limit(state.stale_after()) if state else None
        words = self.trouble
        if state and self.message is not None and not words:
            try:
                words = state.topic.words(self.message)
            except Exception as error:  # pylint: disable=broad-except
                words = _odd(error)
        told = {'rows': rows, 'words': words[:_LONGEST],
                'limit': None if limit is None else round(limit, 2)}
        return {**told, 'fields': self._shape} if fields and self._shape is not None else told


def plain(value: FieldValue) -> Any:
    """As JSON can say it: what is no number as text, the rest without digits nobody sees."""
    number = value.value
    if isinstance(number, str):
        return number[:_LONGEST]
    if not isinstance(number, float):
        return number if abs(number) <= _MOST_DIGITS else str(number)
    if math.isfinite(number):
        return float(f'{number:.7g}') if value.digits is None \
            else round(number, value.digits + 2)
    return 'NaN' if math.isnan(number) else 'Infinity' if number > 0 else '-Infinity'


def _limit(number: Optional[float]) -> Optional[float]:
    """A limit; one that limits nothing, or is no number, is none."""
    return number if number is not None and math.isfinite(number) else None


def _odd(error: Exception) -> str:
    """Whatever another version of the type may make of a message."""
    return f'not as expected: {error}'


class Feed:
    """Looks at one bridge for as long as anybody looks at the page."""

    def __init__(self, node: str, master: str, registrar: Registrar) -> None:
        self.state = BridgeState(node, master=master)
        self._registrar = registrar
        self._looking = False
        self._watcher = self._new_watcher()
        self._log: Optional[rospy.Subscriber] = None    # while the watcher watches
        self._since = 0.0                        # when it began to look
        self._wanted: Set[str] = set()
        self._waiting: Deque[Tuple[BridgeTopic, bytes, float]] = deque(maxlen=_MOST_WAITING)
        self._shown: Dict[str, _Shown] = {}
        self._wire = Wire((), {})
        self._wired: Any = None                  # the parameters that it is made of
        self._told: Dict[str, Any] = {}          # boards and topics
        self._links: Dict[str, Optional[LinkState]] = {}    # that were counted last
        self._errors: Dict[str, Deque[Any]] = {}
        self._lines: Deque[List[Any]] = deque(maxlen=_MOST_LINES)
        self._new_lines: Deque[List[Any]] = deque(maxlen=_MOST_LINES)

    def start(self) -> None:
        """Somebody looks; rospy.init_node has been called."""
        self._looking = True
        self._since = time.monotonic()
        self._registrar.do(self._register)

    def stop(self) -> None:
        """Nobody looks: soon no subscription remains."""
        self._looking = False
        self._waiting.clear()
        self._registrar.do(self._register)

    def want(self, names: Iterable[str]) -> None:
        """These topics are looked at."""
        names = set(names)
        if names != self._wanted:
            self._wanted = names
            self._registrar.do(self._register)

    def _new_watcher(self) -> Watcher:
        return Watcher(self.state, lambda topic: topic.name in self._wanted, self._keep)

    def _register(self) -> None:
        """Have the subscriptions that are wanted now."""
        watches = self._log is not None
        if self._looking and not watches:
            self._log = rospy.Subscriber('/rosout_agg', Log, self._hear, queue_size=100)
            self._watcher = self._new_watcher()
            self._watcher.start()
        elif self._looking:
            self._watcher.subscribe()
        elif watches:
            self._watcher.stop()
            self._log.unregister()
            self._log = None

    # -- in rospy's threads --------------------------------------------------------------------

    def _keep(self, topic: BridgeTopic, packed: bytes, at: float) -> None:
        # /diagnostics is what the links are known from. After `stop`, messages come for as long
        # as the master hangs.
        if topic.name != DIAGNOSTICS and self._looking:
            self._waiting.append((topic, packed, at))

    def _hear(self, line: Log) -> None:
        if line.name == self.state.node:
            self._new_lines.append([round(time.monotonic(), 3), line.level, line.msg[:_LONGEST]])

    # -- updates -------------------------------------------------------------------------------

    def take(self, now: float) -> Tuple[Dict[str, Any], Optional[Dict[str, Any]]]:
        """What has come since the last time; and what of the wire, if anything."""
        frames, left_out = self._unpack()
        lines = [self._new_lines.popleft() for _ in range(len(self._new_lines))]
        self._lines.extend(lines)
        update = {'now': round(now, 4), 'trouble': self._trouble(now)}
        for name, value in (('topics', {topic: shown.news(self.state.topic(topic))
                                        for topic, shown in self._shown.items() if shown.rows}),
                            ('links', self._new_links()), ('log', lines)):
            if value:
                update[name] = value
        for name, value in ('boards', self._boards()), ('known', self._known()):
            if value != self._told.get(name):
                update[name] = self._told[name] = value
        return update, {'frames': frames, 'left_out': left_out} if frames else None

    def everything(self, now: float) -> Dict[str, Any]:
        """All that a page which has just been opened has to know; to be asked after `take`."""
        return {'now': round(now, 4), 'trouble': self._trouble(now), 'node': self.state.node,
                **self._told, 'log': list(self._lines),
                'topics': {name: shown.everything(self.state.topic(name), now)
                           for name, shown in self._shown.items()},
                'links': {name: _tell_link(link, [row for row in self._errors.get(name, ())
                                                  if now - row[0] <= HISTORY])
                          for name, link in self.state.links.items()}}

    def _trouble(self, now: float) -> str:
        """Why nothing new can come; nobody can have answered as soon as they were asked."""
        return self.state.trouble(now) if now - self._since > _FIRST_WORD else ''

    def _unpack(self) -> Tuple[List[Any], int]:
        """Messages into rows, and serial_msg into frames, with how many of these were left out."""
        frames, left_out = [], 0
        for _ in range(len(self._waiting)):
            topic, packed, at = self._waiting.popleft()
            if topic.name == SERIAL_MSG and len(frames) >= _MOST_FRAMES:
                left_out += 1
                continue
            shown = self._shown.setdefault(topic.name, _Shown())
            try:
                message = self._watcher.unpack(topic, packed)
                if topic.name == SERIAL_MSG:
                    frames.append(self._explain(message, at))
                else:
                    shown.add(at, topic.values(message))
                    shown.message, shown.trouble = message, ''
            except Exception as error:  # pylint: disable=broad-except
                shown.trouble = _odd(error)
        return frames, left_out

    def _explain(self, message: Any, at: float) -> List[Any]:
        if self._wired is not self.state.parameters:
            self._wired = self.state.parameters
            self._wire = Wire(self.state.boards, self._wired)
        return self._wire.describe(message, at)

    def _boards(self) -> Dict[str, Any]:
        return {board.name: {'title': board.title, 'longest_gap':
                             board.heartbeat.longest_gap if board.heartbeat else None}
                for board in self.state.boards}

    def _known(self) -> Dict[str, Any]:
        return {each.topic.name: {'type': each.topic.type, 'links': each.topic.links,
                                  'own': each.topic.name not in TABLE}
                for each in self.state.topics}

    def _new_links(self) -> Dict[str, Any]:
        """What /diagnostics has said since the last time."""
        new = {name: link for name, link in self.state.links.items()
               if name not in self._links or link is not self._links[name]}
        told = {name: _tell_link(link, self._count(name, link) if link else [])
                for name, link in new.items()}
        self._links.update(new)
        return told

    def _count(self, name: str, link: LinkState) -> List[Any]:
        """What went wrong on it from its last status to this one: a row, which is kept."""
        before = (self._links.get(name) or link).errors
        # A counter that is lower than it was belongs to a bridge that began anew.
        counts = {cause[:_LONGEST]: count - (before.get(cause, 0) if count >= before.get(cause, 0)
                                             else 0) for cause, count in link.errors.items()}
        row = [round(link.at, 3), {cause: count for cause, count in counts.items() if count}]
        rows = self._errors.setdefault(name, deque())
        rows.append(row)
        while link.at - rows[0][0] > HISTORY:
            rows.popleft()
        return [row]


def _tell_link(link: Optional[LinkState], errors: List[Any]) -> Dict[str, Any]:
    if link is None:
        return {'at': None}
    values = {key[:_LONGEST]: value[:_LONGEST]
              for key, value in islice(link.values.items(), _MOST_KEYS)}
    return {'at': round(link.at, 3), 'level': link.level, 'summary': link.summary[:_LONGEST],
            'values': values, 'errors': errors}
