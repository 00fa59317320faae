"""What was received from one bridge, and how old it is. Imports no ROS and reads no clock.

Times are in seconds of a monotonic clock, the same one in every call.
"""
import re
from collections import deque
from typing import Any, Deque, Dict, Iterable, List, NamedTuple, Optional, Tuple

from .topics import NODE, BridgeTopic, boards_of, in_order

OK, WARN, ERROR, STALE = 0, 1, 2, 3      # as diagnostic_msgs/DiagnosticStatus has them

_PERIODS_TO_STALE = 3    # a value older than this many of its periods is stale
_SOONEST_STALE = 0.3     # s; a busy machine has jitter below this
_LINK_PERIOD = 1.0       # s between two statuses of a link
_NEWEST_WEIGHT = 0.1     # of the newest interval, in the measured period
_FIRST_MESSAGES = 4      # the shortest interval between these is the period at first
_LONGEST_PERIOD = 60.0   # s; at first
_RATE_WINDOW = 5.0       # s over which a rate is counted
_MASTER_TIMEOUT = 3.0    # s


def ago(seconds: float) -> str:
    """Return an age, given in seconds, as short text: 0.4 s, 12 s, 5 min, 3 h."""
    if seconds < 120:
        return f'{seconds:.1f} s' if seconds < 10 else f'{seconds:.0f} s'
    return f'{seconds / 60:.0f} min' if seconds < 7200 else f'{seconds / 3600:.0f} h'


class TopicState:
    """What was received on one topic."""

    def __init__(self, topic: BridgeTopic) -> None:
        self.topic = topic
        self.count = 0
        self.rate: Optional[float] = None     # Hz; None: not known yet
        self.words = ''                       # the latest message at the last `Watcher.update`
        self.last_at: Optional[float] = None
        self._measured_period: Optional[float] = None    # s
        self._counted: Deque[Tuple[float, int]] = deque()

    def received(self, now: float) -> None:
        """Count a message."""
        if self.last_at is not None:
            interval, period = now - self.last_at, self._measured_period
            if period is None or self.count < _FIRST_MESSAGES:
                # One may be a pause: the board was unplugged, or nobody looked.
                self._measured_period = min(interval, period or _LONGEST_PERIOD)
            else:
                # Limited, so that an outage hardly changes the period, but a slower board does.
                interval = min(interval, _PERIODS_TO_STALE * max(period, 0.001))
                self._measured_period = period + _NEWEST_WEIGHT * (interval - period)
        self.count += 1
        self.last_at = now

    def measure(self, now: float) -> None:
        """Update `rate`, the rate over the last 5 s. To be called regularly."""
        self._counted.append((now, self.count))
        while now - self._counted[0][0] > _RATE_WINDOW + 0.5:
            self._counted.popleft()
        began, count = self._counted[0]
        self.rate = (self.count - count) / (now - began) if now > began else None

    def stale_after(self) -> Optional[float]:
        """Return the age in seconds above which its value is stale; None if it never is."""
        periods = [each for each in (self.topic.period, self._measured_period) if each is not None]
        if not self.topic.ages or not periods:
            return None
        return max(_PERIODS_TO_STALE * max(periods), _SOONEST_STALE)

    def stale(self, now: float) -> bool:
        """Whether its value is older than three of its periods."""
        limit = self.stale_after()
        return self.last_at is not None and limit is not None and now - self.last_at > limit


class LinkState(NamedTuple):
    """What /diagnostics reports about one link."""

    level: int                 # OK, WARN, ERROR
    summary: str
    values: Dict[str, str]     # by the keys of /diagnostics
    at: float = 0.0            # when it was received

    @property
    def errors(self) -> Dict[str, int]:
        """The number of errors by cause: checksum, framing …"""
        return {key[:-len(' errors')]: int(value) for key, value in self.values.items()
                if key.endswith(' errors') and re.fullmatch('[0-9]{1,15}', value)}

    def stale(self, now: float) -> bool:
        """Whether it is older than three periods of /diagnostics."""
        return now - self.at > _PERIODS_TO_STALE * _LINK_PERIOD


class BridgeState:
    """The state of one bridge.

    Args:
        node: its full name.
        master: the master's address, for texts.
    """

    def __init__(self, node: str = NODE, master: str = '') -> None:
        self.node = node
        self.master = master
        self.master_at: Optional[float] = None     # when the master answered last
        self.registered: Optional[bool] = None     # whether the master knows the node
        self.parameters: Dict[str, Any] = {}       # private ones, nested; empty until known
        self.boards = boards_of({})                # by these parameters
        self.topics: List[TopicState] = []
        self.links: Dict[str, Optional[LinkState]] = {}

    def topic(self, name: str) -> Optional[TopicState]:
        """Return the state of the topic with this relative name, or None."""
        return next((each for each in self.topics if each.topic.name == name), None)

    def set_parameters(self, parameters: Dict[str, Any]) -> None:
        """Set the node's private parameters, nested, and the boards they name."""
        if parameters != self.parameters:
            self.boards = boards_of(parameters)
            self.parameters = parameters

    def set_topics(self, topics: Iterable[BridgeTopic]) -> None:
        """Replace the topics by these. A topic in both keeps its state."""
        old = {(each.topic.name, each.topic.type): each for each in self.topics}
        new = []
        for topic in topics:
            new.append(old.get((topic.name, topic.type)) or TopicState(topic))
            new[-1].topic = topic
        self.topics = new

    def expect_links(self, names: Iterable[str]) -> None:
        """Add links that are on. A new one has no status until /diagnostics reports it."""
        self._set_links({**dict.fromkeys(names), **self.links})

    def set_link(self, name: str, link: LinkState) -> None:
        """Set the status of a link, from /diagnostics."""
        self._set_links({**self.links, name: link})

    def _set_links(self, links: Dict[str, Any]) -> None:
        self.links = {name: links[name] for name in in_order(links)}

    def master_answered(self, registered: bool, now: float) -> None:
        """Store the master's answer: whether it knows the node."""
        self.registered, self.master_at = registered, now

    def reported_at(self) -> Optional[float]:
        """Return when the bridge last reported on a link, or None."""
        return max((link.at for link in self.links.values() if link), default=None)

    def trouble(self, now: float) -> str:
        """Return why nothing new can be received, in words; '' while the bridge reports."""
        reported = self.reported_at()
        if self.master_at is None or now - self.master_at > _MASTER_TIMEOUT:
            return f'no answer from the ROS master at {self.master}'
        if reported is not None and now - reported <= _PERIODS_TO_STALE * _LINK_PERIOD:
            return ''
        if self.registered is False:
            return f'no bridge {self.node} at {self.master}'
        return f'the bridge {self.node} has reported nothing' + (
            ' yet' if reported is None else f' for {ago(now - reported)}')

    def all_ok(self, now: float) -> bool:
        """Whether the bridge reports, it has links, and every link is OK."""
        return not self.trouble(now) and bool(self.links) and all(
            link is not None and link.level == OK and not link.stale(now)
            for link in self.links.values())
