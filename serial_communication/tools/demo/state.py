"""What the demo shows beyond the bridge itself: its boards, its calls and what it sends."""
from typing import List, NamedTuple, Optional, Sequence

from ...link.outcome import Verdict
from ..watch.state import ERROR, OK, BridgeState
from ..watch.table import LEVELS, Frame, Line
from ..watch.topics import LINKS, NODE, TOPICS


class Calls:
    """The calls of one service."""

    def __init__(self) -> None:
        self.words = 'not called yet'      # of the latest
        self._counts = {verdict: 0 for verdict in Verdict}

    def answered(self, what: str, verdict: Verdict, words: str, seconds: float) -> None:
        """One more has ended: what was asked, what became of it, and after how long."""
        self._counts[verdict] += 1
        said = verdict.value if verdict is Verdict.DONE else f'{verdict.value}: {words}'
        counts = ', '.join(f'{count} {each.value}' for each, count in self._counts.items()
                           if count or each is Verdict.DONE)
        self.words = f'{what}: {said}, after {seconds:.2f} s ({counts})'

    @property
    def succeeded(self) -> bool:
        """Whether one has."""
        return self._counts[Verdict.DONE] > 0

    @property
    def failed(self) -> bool:
        """Whether none of those that ended has succeeded."""
        return not self.succeeded and any(self._counts.values())


class Commands(NamedTuple):
    """The latest that was published for the car."""

    speed: int
    steering: int
    led: str


class State:
    """All that the demo's table shows."""

    def __init__(self, boards: str = 'simulated', links: Sequence[str] = LINKS,
                 moves: bool = True, setup: str = '', master: str = '',
                 page: str = '') -> None:
        self.boards = boards
        self.page = page             # the panel's address
        self.setup = setup           # the line that a second terminal needs
        self.elapsed = 0.0           # s
        self.bridge = BridgeState(NODE, [topic for topic in TOPICS
                                         if set(topic.links) & set(links)], links, master)
        self.calls = {'lift': Calls(), 'gimbal': Calls()} if moves and 'bus' in links else {}
        self.commands: Optional[Commands] = None

    def links_open(self) -> bool:
        """Whether every link has said that its port is open and its board answers."""
        return all(link is not None and link.level < ERROR
                   for link in self.bridge.links.values())

    def refusal(self) -> str:
        """Why the bridge refuses commands for the car now, in a word or two; else empty."""
        calibrating = self.bridge.topic('~imu/calibrating')
        if calibrating and any(value.value is True for value in calibrating.values):
            return 'calibrating'
        link = self.bridge.links.get('arduino')
        return 'port closed' if link and link.level == ERROR else ''

    def missing(self) -> List[str]:
        """What has not been shown to work, in words; empty if everything has."""
        out = [f'no data on {each.topic.name}' for each in self.bridge.topics
               if not each.count and not each.topic.optional]
        return out + [f'no successful answer from {name}: {calls.words}'
                      for name, calls in self.calls.items() if not calls.succeeded]

    def trouble(self) -> List[str]:
        """The links that are not OK by their latest status, in words."""
        return [f'{name} {LEVELS[link.level]}: {link.summary}'
                for name, link in self.bridge.links.items() if link and link.level != OK]

    def frame(self) -> Frame:
        """What stands around the links and topics."""
        commands = [Line(f'{name:<7} {calls.words}', 'bad' if calls.failed else 'plain')
                    for name, calls in self.calls.items()]
        refusal = self.refusal()
        if self.commands and refusal:
            commands.append(Line(f'car     speed refused: {refusal}', 'warn'))
        elif self.commands:
            speed, steering, led = self.commands
            commands.append(Line(
                f"car     ~speed {speed}, ~steering {steering}, ~led {led or '-'}"))
        notes = [Line('In another terminal:  ' + self.setup, whole=True)] if self.setup else []
        if self.page:
            notes.append(Line('In a browser:  ' + self.page, whole=True))
        return Frame((f'{self.boards.capitalize()} boards, {self.elapsed:.0f} s.',
                      'Ctrl-C ends it.', f'~ is {NODE}/'), tuple(notes),
                     tuple(commands) or (Line('none: real boards are only looked at'),))
