"""What has come from one bridge, and how old it is; knows no ROS and no clock of its own.

Times are seconds of any monotonic clock, the same one in every call.
"""
import re
from collections import deque
from typing import Any, Deque, Dict, Iterable, List, NamedTuple, Optional, Tuple

from ...boards.description import Description
from .topics import NODE, Topic, boards_of, in_order, in_table_order

OK, WARN, ERROR, STALE = 0, 1, 2, 3      # as diagnostic_msgs/DiagnosticStatus has them

_PERIODS_TO_STALE = 3    # a value that has not been renewed for so many of its periods is stale
_SOONEST_STALE = 0.3     # s; less is the jitter of a busy machine, and nobody could see it
_LINK_PERIOD = 1.0       # s from one status of a link to the next
_LEARNED = 0.1           # weight of the newest interval in the period that is found by looking
_RATE_WINDOW = 5.0       # s over which a rate is counted
_MASTER_SILENCE = 3.0    # s


def ago(seconds: float) -> str:
    """An age in few characters: 0.4 s, 12 s, 5 min, 3 h."""
    if seconds < 120:
        return f'{seconds:.1f} s' if seconds < 10 else f'{seconds:.0f} s'
    return f'{seconds / 60:.0f} min' if seconds < 7200 else f'{seconds / 3600:.0f} h'


class TopicState:
    """What has come on one topic."""

    def __init__(self, topic: Topic) -> None:
        self.topic = topic
        self.count = 0
        self.rate: Optional[float] = None     # Hz; None: not known yet
        self.message: Any = None              # the latest, as of the last look
        self.words = ''                       # of that message
        self.last_at: Optional[float] = None
        self._learned: Optional[float] = None    # s, the period as found by looking
        self._counted: Deque[Tuple[float, int]] = deque()

    def take(self, now: float) -> None:
        """A message has come."""
        if self.last_at is not None:
            interval = now - self.last_at
            if self._learned is None:
                self._learned = interval
            # An outage is no period, but a board that has really become slower is learned.
            interval = min(interval, _PERIODS_TO_STALE * max(self._learned, 0.001))
            self._learned += _LEARNED * (interval - self._learned)
        self.count += 1
        self.last_at = now

    def measure(self, now: float) -> None:
        """To be called at every look: the rate over the last few seconds."""
        self._counted.append((now, self.count))
        while now - self._counted[0][0] > _RATE_WINDOW + 0.5:
            self._counted.popleft()
        began, count = self._counted[0]
        self.rate = (self.count - count) / (now - began) if now > began else None

    def age(self, now: float) -> Optional[float]:
        """Seconds since the latest message; None if there was none."""
        return None if self.last_at is None else max(0.0, now - self.last_at)

    def stale_after(self) -> Optional[float]:
        """The age in seconds above which its value is stale; None: no age is too old."""
        periods = [each for each in (self.topic.period, self._learned) if each is not None]
        if not self.topic.ages or not periods:
            return None
        return max(_PERIODS_TO_STALE * max(periods), _SOONEST_STALE)

    def stale(self, now: float) -> bool:
        """Whether its value has not been renewed for three of its periods."""
        age, limit = self.age(now), self.stale_after()
        return age is not None and limit is not None and age > limit


class LinkState(NamedTuple):
    """What /diagnostics says about one link."""

    level: int                 # OK, WARN, ERROR
    summary: str
    values: Dict[str, str]     # by the keys of /diagnostics
    at: float = 0.0            # when it was said

    @property
    def errors(self) -> Dict[str, int]:
        """How often what has gone wrong on the line, by cause: checksum, framing …"""
        return {key[:-len(' errors')]: int(value) for key, value in self.values.items()
                if key.endswith(' errors') and re.fullmatch('[0-9]{1,15}', value)}

    def stale(self, now: float) -> bool:
        """Whether it has not been said again for three periods of /diagnostics."""
        return now - self.at > _PERIODS_TO_STALE * _LINK_PERIOD


class BridgeState:
    """All that is known of one bridge.

    Args:
        node: its full name.
        topics: what it is expected to publish, before a master has been asked.
        links: likewise those that are on.
        master: where the master is, for people.
    """

    def __init__(self, node: str = NODE, topics: Iterable[Topic] = (),
                 links: Iterable[str] = (), master: str = '') -> None:
        self.node = node
        self.master = master
        self.master_at: Optional[float] = None     # when the master answered last
        self.registered: Optional[bool] = None     # whether the master knows the node
        self._registered_since: float = 0.0        # when that last changed
        self.parameters: Dict[str, Any] = {}       # its private ones, nested; not known: none
        self.boards = boards_of({})                # of these parameters
        self._expected = list(topics)
        self.topics: List[TopicState] = [TopicState(topic) for topic in self._expected]
        self.links: Dict[str, Optional[LinkState]] = dict.fromkeys(in_order(links))

    def topic(self, name: str) -> Optional[TopicState]:
        """The topic of this (relative) name."""
        return next((each for each in self.topics if each.topic.name == name), None)

    def learn(self, parameters: Dict[str, Any]) -> None:
        """The node has these private parameters, nested."""
        if parameters != self.parameters:
            self.boards = boards_of(parameters)
            self.parameters = parameters

    def board(self, link: str) -> Optional[Description]:
        """The board of a link, if it is known here."""
        return next((each for each in self.boards if each.name == link), None)

    def set_topics(self, topics: Iterable[Topic]) -> None:
        """These are its topics, with those expected; what has come on one that stays is kept."""
        old = {each.topic.name: each for each in self.topics}
        new = []
        for topic in in_table_order([*self._expected, *topics]):
            each = old.get(topic.name)
            if each is None or each.topic.type != topic.type:
                each = TopicState(topic)
            each.topic = topic
            new.append(each)
        self.topics = new

    def expect_links(self, names: Iterable[str]) -> None:
        """These links are on; nothing has been said of a new one yet."""
        self._set_links({**dict.fromkeys(names), **self.links})

    def take_link(self, name: str, link: LinkState) -> None:
        """/diagnostics has said this."""
        self._set_links({**self.links, name: link})

    def _set_links(self, links: Dict[str, Any]) -> None:
        self.links = {name: links[name] for name in in_order(links)}

    def master_says(self, registered: bool, now: float) -> None:
        """The master has answered whether it knows the node."""
        if registered != self.registered:
            self.registered, self._registered_since = registered, now
        self.master_at = now

    def said_at(self) -> Optional[float]:
        """When the bridge last said how a link is."""
        return max((link.at for link in self.links.values() if link), default=None)

    def trouble(self, now: float) -> str:
        """Why nothing new can come, in words; empty while the bridge talks."""
        said = self.said_at()
        talks = said is not None and now - said <= _PERIODS_TO_STALE * _LINK_PERIOD
        if self.master_at is None or now - self.master_at > _MASTER_SILENCE:
            age = '' if self.master_at is None else f' for {ago(now - self.master_at)}'
            return f'no answer from the ROS master at {self.master}{age}'
        if self.registered is False:
            if talks:
                # It may have come, or gone, since the master was asked.
                return '' if now - self._registered_since < _MASTER_SILENCE else \
                    f'the master at {self.master} does not know the bridge {self.node}, ' \
                    'which runs: restart the bridge'
            return f'no bridge {self.node} at {self.master}'
        if not talks:
            return f'the bridge {self.node} has said nothing' + (
                ' yet' if said is None else f' for {ago(now - said)}')
        return ''

    def all_ok(self, now: float) -> bool:
        """Whether the bridge talks, and every link is OK."""
        return not self.trouble(now) and bool(self.links) and all(
            link is not None and link.level == OK and not link.stale(now)
            for link in self.links.values())
