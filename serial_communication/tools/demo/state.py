"""What the demo shows beyond the bridge itself: its boards, its calls and what it sends."""
from typing import List, Sequence, Tuple

from ...link.outcome import Verdict
from ..watch.state import ERROR, OK, BridgeState
from ..watch.table import LEVELS, Heading, TextLine
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


class Demo:
    """All that the demo's table shows.

    Args:
        boards: what to call them.
        setup: the line that a second terminal needs.
        page: the panel's address.
    """

    def __init__(self, boards: str = 'simulated', links: Sequence[str] = LINKS,
                 moves: bool = True, setup: str = '', master: str = '', page: str = '') -> None:
        self.bridge = BridgeState(NODE, [topic for topic in TOPICS
                                         if set(topic.links) & set(links)], links, master)
        self.calls = {'lift': Calls(), 'gimbal': Calls()} if moves and 'bus' in links else {}
        self.driving = ''            # the latest that was published for the car
        self._boards = boards
        self._notes = [TextLine(words + text, whole=True) for words, text in (
            ('In another terminal:  ', setup), ('In a browser:  ', page)) if text]

    def links_open(self) -> bool:
        """Whether every link has said that its port is open and its board answers."""
        return all(link is not None and link.level < ERROR
                   for link in self.bridge.links.values())

    def refusal(self) -> str:
        """Why the bridge refuses commands for the car now, in a word or two; else empty."""
        calibrating = self.bridge.topic('~imu/calibrating')
        if calibrating and calibrating.message and calibrating.message.data:
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

    def heading(self, elapsed: float, notes: Tuple[TextLine, ...] = ()) -> Heading:
        """What stands around the links and topics after so many seconds."""
        commands = [TextLine(f'{name:<7} {calls.words}', 'bad' if calls.failed else 'plain')
                    for name, calls in self.calls.items()]
        refusal = self.refusal()
        if self.driving:
            commands.append(TextLine(f'car     speed refused: {refusal}', 'warn') if refusal
                            else TextLine(f'car     {self.driving}'))
        return Heading(
            (f'{self._boards.capitalize()} boards, {elapsed:.0f} s.', 'Ctrl-C ends it.',
             f'~ is {NODE}/'), (*self._notes, *notes),
            tuple(commands) or (TextLine('none: real boards are only looked at'),))
