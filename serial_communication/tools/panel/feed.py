"""What the page is told of the bridge: rows of numbers, words, links and frames.

Messages are taken as they come and unpacked on the IO loop, once a tick, all of them, so that a
plot shows every one. Everything but `_keep` and `_hear` (rospy's threads) and `_register` (the
registrar's) runs on the IO loop, which never waits for the master.
"""
import math
import time
from collections import deque
from itertools import islice
from typing import Any, Deque, Dict, Iterable, List, NamedTuple, Optional, Set, Tuple

import rospy
from rosgraph_msgs.msg import Log

from ..watch.state import BridgeState
from ..watch.topics import DIAGNOSTICS, SERIAL_MSG, TOPICS, Topic, Value
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

_TABLE = {topic.name for topic in TOPICS}


class _Shown:
    """What the page knows of one topic."""

    def __init__(self) -> None:
        self.shape: Optional[Tuple] = None   # of each value of a row: what it is
        self.rows: List[List[Any]] = []      # that the page has not been told yet
        self.last: Optional[List[Any]] = None
        self.message: Any = None             # the latest
        self.trouble = ''                    # why there is none
        self.history: Deque[List[Any]] = deque()
        self.changed = False                 # the shape, since the last update

    def add(self, at: float, values: Iterable[Value]) -> None:
        """Another message has come."""
        values = tuple(values)
        shape = tuple((each.name, each.unit, each.digits, _limit(each.low), _limit(each.high))
                      for each in values)
        if shape != self.shape:
            if self.shape and [each[0] for each in shape] != [each[0] for each in self.shape]:
                self.history.clear()
                self.rows.clear()
            self.shape, self.changed = shape, True
        row = [round(at, 4), *(plain(each) for each in values)]
        # Only what comes slowly is kept for those who open the page later: minutes of what comes
        # a hundred times a second would be megabytes.
        if self.last and at - self.last[0] >= _SPARSE:
            self.history.append(row)
            while at - self.history[0][0] > HISTORY:
                self.history.popleft()
        self.last = row
        self.rows.append(row)


def plain(value: Value) -> Any:
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


class _Errors(NamedTuple):
    """What went wrong on a link from one status to the next."""

    at: float
    counts: Dict[str, int]     # by cause; only what is not 0


class Feed:
    """Looks at one bridge for as long as anybody looks at the page."""

    def __init__(self, node: str, master: str, registrar: Registrar) -> None:
        self._state = BridgeState(node, master=master)
        self._registrar = registrar
        self._looking = False
        self._watcher = self._new_watcher()
        self._log: Optional[rospy.Subscriber] = None    # while the watcher watches
        self._since = 0.0                        # when it began to look
        self._wanted: Set[str] = set()
        self._waiting: Deque[Tuple[Topic, bytes, float]] = deque(maxlen=_MOST_WAITING)
        self._shown: Dict[str, _Shown] = {}
        self._wire = Wire({})
        self._wired: Any = None                  # the parameters that it is made of
        self._told_topics: Optional[List[Topic]] = None
        self._links: Dict[str, Any] = {}         # name -> the LinkState that was counted last
        self._errors: Dict[str, Deque[_Errors]] = {}
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

    @property
    def parameters(self) -> Any:
        """The node's private parameters, nested; the same object until they change."""
        return self._state.parameters

    def want(self, names: Iterable[str]) -> None:
        """These topics are looked at."""
        names = set(names)
        if names != self._wanted:
            self._wanted = names
            self._registrar.do(self._register)

    def _new_watcher(self) -> Watcher:
        return Watcher(self._state, self._wants, self._keep)

    def _wants(self, topic: Topic) -> bool:
        return topic.name in self._wanted

    def _register(self) -> None:
        """Have the subscriptions that are wanted now."""
        watches = self._log is not None
        if self._looking and not watches:
            self._log = rospy.Subscriber('/rosout_agg', Log, self._hear, queue_size=100)
            self._watcher = self._new_watcher()
            self._watcher.start()
        elif self._looking:
            self._watcher.want(self._wants)
        elif watches:
            self._watcher.stop()
            self._log.unregister()
            self._log = None

    # -- in rospy's threads --------------------------------------------------------------------

    def _keep(self, topic: Topic, packed: bytes, at: float) -> None:
        # /diagnostics is what the links are known from. After `stop`, messages come for as long
        # as the master hangs.
        if topic.name != DIAGNOSTICS and self._looking:
            self._waiting.append((topic, packed, at))

    def _hear(self, line: Log) -> None:
        if line.name == self._state.node:
            self._new_lines.append([round(time.monotonic(), 3), line.level, line.msg[:_LONGEST]])

    # -- updates -------------------------------------------------------------------------------

    def take(self, now: float) -> Tuple[Dict[str, Any], Optional[Dict[str, Any]]]:
        """What has come since the last time; and what of the wire, if anything."""
        frames, left_out = self._unpack()
        update: Dict[str, Any] = {'now': round(now, 4), 'trouble': self._trouble(now)}
        topics = {name: self._tell(name, shown, shown.rows)
                  for name, shown in self._shown.items() if shown.rows}
        for name in topics:
            self._shown[name].rows = []
            self._shown[name].changed = False
        if topics:
            update['topics'] = topics
        known = [each.topic for each in self._state.topics]
        if known != self._told_topics:
            self._told_topics = known
            update['known'] = self._known()
        links = {name: self._tell_link(link, rows)
                 for name, link, rows in self._new_links()}
        if links:
            update['links'] = links
        if self._new_lines:
            lines = [self._new_lines.popleft() for _ in range(len(self._new_lines))]
            self._lines.extend(lines)
            update['log'] = lines
        wire = {'frames': frames, 'left_out': left_out} if frames else None
        return update, wire

    def everything(self, now: float) -> Dict[str, Any]:
        """All that a page which has just been opened has to know; to be asked after `take`."""
        update: Dict[str, Any] = {
            'now': round(now, 4), 'trouble': self._trouble(now), 'node': self._state.node,
            'known': self._known(), 'log': list(self._lines), 'topics': {}, 'links': {}}
        for name, shown in self._shown.items():
            rows = [row for row in shown.history if now - row[0] <= HISTORY]
            if shown.last and (not rows or rows[-1] is not shown.last):
                rows.append(shown.last)
            update['topics'][name] = self._tell(name, shown, rows, fields=True)
        for name, link in self._state.links.items():
            update['links'][name] = self._tell_link(link, [
                each for each in self._errors.get(name, ()) if now - each.at <= HISTORY])
        return update

    def _trouble(self, now: float) -> str:
        """Why nothing new can come; nobody can have answered as soon as they were asked."""
        return self._state.trouble(now) if now - self._since > _FIRST_WORD else ''

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
                # Whatever another version of the type may make of it.
                shown.trouble = f'not as expected: {error}'
        return frames, left_out

    def _explain(self, message: Any, at: float) -> List[Any]:
        if self._wired is not self._state.parameters:
            self._wired = self._state.parameters
            self._wire = Wire(self._wired)
        return self._wire.describe(message, at)

    def _known(self) -> Dict[str, Any]:
        return {topic.name: {'type': topic.type, 'links': topic.links,
                             'own': topic.name not in _TABLE}
                for topic in self._told_topics or ()}

    def _tell(self, name: str, shown: _Shown, rows: List[Any],
              fields: bool = False) -> Dict[str, Any]:
        state = self._state.topic(name)
        limit = _limit(state.stale_after()) if state else None
        words = shown.trouble
        if state and shown.message is not None and not words:
            try:
                words = state.topic.words(shown.message)
            except Exception as error:  # pylint: disable=broad-except
                words = f'not as expected: {error}'
        told = {'rows': rows, 'words': words[:_LONGEST],
                'limit': None if limit is None else round(limit, 2)}
        if shown.shape is not None and (fields or shown.changed):
            told['fields'] = shown.shape
        return told

    def _new_links(self) -> Iterable[Tuple[str, Any, List[_Errors]]]:
        for name, link in list(self._state.links.items()):
            before = self._links.get(name)
            if name in self._links and link is before:
                continue
            self._links[name] = link
            rows = []
            if link is not None:
                errors = self._errors.setdefault(name, deque())
                was = before.errors if before else link.errors
                # A counter that is lower than it was belongs to a bridge that began anew.
                counts = {cause[:_LONGEST]: count - was.get(cause, 0) if count >= was.get(cause, 0)
                          else count for cause, count in link.errors.items()}
                row = _Errors(round(link.at, 3), {cause: count for cause, count
                                                  in counts.items() if count})
                errors.append(row)
                while link.at - errors[0].at > HISTORY:
                    errors.popleft()
                rows.append(row)
            yield name, link, rows

    @staticmethod
    def _tell_link(link: Any, errors: Iterable[_Errors]) -> Dict[str, Any]:
        if link is None:
            return {'at': None}
        values = {key[:_LONGEST]: value[:_LONGEST]
                  for key, value in islice(link.values.items(), _MOST_KEYS)}
        return {'at': round(link.at, 3), 'level': link.level, 'summary': link.summary[:_LONGEST],
                'values': values, 'errors': list(errors)}
