"""What the page shows of the bridge: samples of topics, texts, links, log lines and frames.

rospy's threads queue the packed messages (`_on_message`, `_on_log`). The IO loop unpacks all of
them once a tick, so that a plot shows every one. `_register` runs in the registrar's thread, so
that the IO loop never waits for the master.
"""
import math
import time
from collections import deque
from itertools import islice
from typing import Any, Deque, Dict, Iterable, List, Optional, Set, Tuple

import rospy
from rosgraph_msgs.msg import Log

from ...ros.background import LatestWorker
from ..watch.state import BridgeState, LinkState, TopicState
from ..watch.topics import DIAGNOSTICS, SERIAL_MSG, BridgeTopic, FieldValue
from ..watch.watcher import Watcher
from .wire import FrameExplainer

HISTORY = 600.0         # s for which samples and errors are kept
_MIN_GAP = 0.5          # s after the last sample, for a sample to be kept in the history
_FIRST_ANSWER = 1.5     # s that master and bridge have to answer after a page was opened
_MAX_WAITING = 2000     # messages that wait for the IO loop; the oldest are dropped
_MAX_FRAMES = 100       # in one update: 2500 a second
_MAX_LINES = 100        # of the log that are kept
_MAX_TEXT = 500         # characters of a text that are shown
_MAX_KEYS = 200         # of a link's values
_OF_SETTINGS = 'settings', 'settings unconfirmed'     # those with the values of all settings
_MAX_SETTINGS = 20000   # characters of them
_MAX_INTEGER = 2 ** 53  # a browser rounds larger integers


class _TopicSamples:
    """The samples of one topic: [time, value …] of each message."""

    def __init__(self) -> None:
        self.samples: List[List[Any]] = []   # since the last update
        self.message: Any = None             # the latest
        self.trouble = ''                    # why the latest message could not be read
        self._fields: Optional[Tuple] = None    # (name, unit, digits, low, high) of each value
        self._changed = False                # the fields, since the last update
        self._last: Optional[List[Any]] = None
        self._history: Deque[List[Any]] = deque()

    def add(self, at: float, values: Iterable[FieldValue]) -> None:
        """Add the values of a message."""
        values = tuple(values)
        fields = tuple((each.name, each.unit, each.digits, _finite(each.low), _finite(each.high))
                       for each in values)
        if fields != self._fields:
            if self._fields and [each[0] for each in fields] != [each[0] for each in self._fields]:
                self._history.clear()
                self.samples.clear()
            self._fields, self._changed = fields, True
        sample = [round(at, 4), *(json_value(each) for each in values)]
        # Pages that are opened later get the history of slow topics only: at a hundred samples a
        # second, ten minutes are megabytes.
        if self._last and at - self._last[0] >= _MIN_GAP:
            self._history.append(sample)
            while at - self._history[0][0] > HISTORY:
                self._history.popleft()
        self._last = sample
        self.samples.append(sample)

    def changes(self, state: Optional[TopicState]) -> Dict[str, Any]:
        """What has changed since the last call."""
        update = self._update(state, self.samples, self._changed)
        self.samples, self._changed = [], False
        return update

    def snapshot(self, state: Optional[TopicState], now: float) -> Dict[str, Any]:
        """The history, the latest sample and the fields."""
        samples = [sample for sample in self._history if now - sample[0] <= HISTORY]
        if self._last and (not samples or samples[-1] is not self._last):
            samples.append(self._last)
        return self._update(state, samples, True)

    def _update(self, state: Optional[TopicState], samples: List[Any],
                with_fields: bool) -> Dict[str, Any]:
        limit = _finite(state.stale_after()) if state else None
        words = self.trouble
        if state and self.message is not None and not words:
            try:
                words = state.topic.words(self.message)
            except Exception as error:  # pylint: disable=broad-except
                words = _unreadable(error)
        update = {'samples': samples, 'words': words[:_MAX_TEXT],
                  'limit': None if limit is None else round(limit, 2)}
        if with_fields and self._fields is not None:
            update['fields'] = self._fields
        return update


def json_value(value: FieldValue) -> Any:
    """The value for strict JSON: a number with few digits, or a text if JSON has no such number."""
    number = value.value
    if isinstance(number, str):
        return number[:_MAX_TEXT]
    if not isinstance(number, float):
        return number if abs(number) <= _MAX_INTEGER else str(number)
    if math.isfinite(number):
        return float(f'{number:.7g}') if value.digits is None \
            else round(number, value.digits + 2)
    return 'NaN' if math.isnan(number) else 'Infinity' if number > 0 else '-Infinity'


def _finite(limit: Optional[float]) -> Optional[float]:
    """The limit; None if it is NaN or infinite."""
    return limit if limit is not None and math.isfinite(limit) else None


def _unreadable(error: Exception) -> str:
    """What is shown of a message whose type may be of another version than the one here."""
    return f'the message cannot be read: {error}'


class Feed:
    """Observes one bridge while a page is open."""

    def __init__(self, node: str, master: str, registrar: LatestWorker) -> None:
        self.state = BridgeState(node, master=master)
        self._registrar = registrar
        self._active = False
        self._watcher = self._new_watcher()
        self._log: Optional[rospy.Subscriber] = None    # while the watcher runs
        self._since = 0.0                        # when it became active
        self._wanted: Set[str] = set()
        self._waiting: Deque[Tuple[BridgeTopic, bytes, float]] = deque(maxlen=_MAX_WAITING)
        self._samples: Dict[str, _TopicSamples] = {}
        self._explainer = FrameExplainer((), {})
        self._explainer_parameters: Any = None   # that it was made from
        self._sent: Dict[str, Any] = {}          # `boards` and `known`, as sent last
        self._links: Dict[str, Optional[LinkState]] = {}    # as sent last
        self._errors: Dict[str, Deque[Any]] = {}
        self._lines: Deque[List[Any]] = deque(maxlen=_MAX_LINES)
        self._new_lines: Deque[List[Any]] = deque(maxlen=_MAX_LINES)

    def start(self) -> None:
        """A page is open, and rospy.init_node has been called: subscribe."""
        self._active = True
        self._since = time.monotonic()
        self._registrar.submit(self._register)

    def stop(self) -> None:
        """No page is open: unsubscribe from everything, soon."""
        self._active = False
        self._waiting.clear()
        self._registrar.submit(self._register)

    def want(self, names: Iterable[str]) -> None:
        """Subscribe to these topics, and to no other."""
        names = set(names)
        if names != self._wanted:
            self._wanted = names
            self._registrar.submit(self._register)

    def _new_watcher(self) -> Watcher:
        return Watcher(self.state, lambda topic: topic.name in self._wanted, self._on_message)

    def _register(self) -> None:
        """Subscribe to what is wanted now. Runs in the registrar's thread."""
        if self._active and self._log is None:
            self._log = rospy.Subscriber('/rosout_agg', Log, self._on_log, queue_size=100)
            self._watcher = self._new_watcher()
            self._watcher.start()
        elif self._active:
            self._watcher.subscribe()
        elif self._log is not None:
            self._watcher.stop()
            self._log.unregister()
            self._log = None

    # -- in rospy's threads --------------------------------------------------------------------

    def _on_message(self, topic: BridgeTopic, packed: bytes, at: float) -> None:
        # The watcher itself reads /diagnostics. If the master hangs, messages are still received
        # after `stop`.
        if topic.name != DIAGNOSTICS and self._active:
            self._waiting.append((topic, packed, at))

    def _on_log(self, line: Log) -> None:
        if line.name == self.state.node:
            self._new_lines.append([round(time.monotonic(), 3), line.level, line.msg[:_MAX_TEXT]])

    # -- updates -------------------------------------------------------------------------------

    def changes(self, now: float) -> Tuple[Dict[str, Any], Optional[Dict[str, Any]]]:
        """What has changed since the last call; and the frames of the wire, if any."""
        frames, left_out = self._unpack()
        lines = [self._new_lines.popleft() for _ in range(len(self._new_lines))]
        self._lines.extend(lines)
        update = {'now': round(now, 4), 'trouble': self._trouble(now)}
        for name, value in (('topics', {topic: each.changes(self.state.topic(topic))
                                        for topic, each in self._samples.items() if each.samples}),
                            ('links', self._new_links()), ('log', lines)):
            if value:
                update[name] = value
        for name, value in ('boards', self._boards()), ('known', self._known()):
            if value != self._sent.get(name):
                update[name] = self._sent[name] = value
        return update, {'frames': frames, 'left_out': left_out} if frames else None

    def snapshot(self, now: float) -> Dict[str, Any]:
        """The whole state, for a page that has just been opened. Call it after `changes`."""
        return {'now': round(now, 4), 'trouble': self._trouble(now), 'node': self.state.node,
                **self._sent, 'log': list(self._lines),
                'topics': {name: each.snapshot(self.state.topic(name), now)
                           for name, each in self._samples.items()},
                'links': {name: _link_update(link, [entry for entry in self._errors.get(name, ())
                                                    if now - entry[0] <= HISTORY])
                          for name, link in self.state.links.items()}}

    def _trouble(self, now: float) -> str:
        """Why nothing new can be received; '' while master and bridge have time to answer."""
        return self.state.trouble(now) if now - self._since > _FIRST_ANSWER else ''

    def _unpack(self) -> Tuple[List[Any], int]:
        """Unpack the messages that wait; return frames, and how many frames were left out."""
        frames: List[Any] = []
        left_out = 0
        for _ in range(len(self._waiting)):
            topic, packed, at = self._waiting.popleft()
            if topic.name == SERIAL_MSG and len(frames) >= _MAX_FRAMES:
                left_out += 1
                continue
            samples = self._samples.setdefault(topic.name, _TopicSamples())
            try:
                message = self._watcher.unpack(topic, packed)
                if topic.name == SERIAL_MSG:
                    frames.append(self._explain(message, at))
                else:
                    samples.add(at, topic.values(message))
                    samples.message, samples.trouble = message, ''
            except Exception as error:  # pylint: disable=broad-except
                samples.trouble = _unreadable(error)
        return frames, left_out

    def _explain(self, message: Any, at: float) -> List[Any]:
        if self._explainer_parameters is not self.state.parameters:
            self._explainer_parameters = self.state.parameters
            self._explainer = FrameExplainer(self.state.boards, self._explainer_parameters)
        return self._explainer.explain(message, at)

    def _boards(self) -> Dict[str, Any]:
        return {board.name: {'title': board.title, 'longest_gap': board.longest_gap}
                for board in self.state.boards}

    def _known(self) -> Dict[str, Any]:
        return {each.topic.name: {'type': each.topic.type, 'links': each.topic.links,
                                  'card': each.topic.card}
                for each in self.state.topics}

    def _new_links(self) -> Dict[str, Any]:
        """The links with a new status in /diagnostics."""
        new = {name: link for name, link in self.state.links.items()
               if name not in self._links or link is not self._links[name]}
        updates = {name: _link_update(link, self._count_errors(name, link) if link else [])
                   for name, link in new.items()}
        self._links.update(new)
        return updates

    def _count_errors(self, name: str, link: LinkState) -> List[Any]:
        """Keep and return what went wrong since the last status: one entry of `errors`."""
        before = (self._links.get(name) or link).errors
        # A counter that is lower than before belongs to a bridge that was restarted.
        counts = {cause[:_MAX_TEXT]: count - (before.get(cause, 0) if count >= before.get(cause, 0)
                                              else 0) for cause, count in link.errors.items()}
        entry = [round(link.at, 3), {cause: count for cause, count in counts.items() if count}]
        entries = self._errors.setdefault(name, deque())
        entries.append(entry)
        while link.at - entries[0][0] > HISTORY:
            entries.popleft()
        return [entry]


def _link_update(link: Optional[LinkState], errors: List[Any]) -> Dict[str, Any]:
    if link is None:
        return {'at': None}
    values = {key[:_MAX_TEXT]: value[:_MAX_SETTINGS if key in _OF_SETTINGS else _MAX_TEXT]
              for key, value in islice(link.values.items(), _MAX_KEYS)}
    return {'at': round(link.at, 3), 'level': link.level, 'summary': link.summary[:_MAX_TEXT],
            'values': values, 'errors': errors}
