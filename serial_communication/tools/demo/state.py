"""What the demo shows beyond the bridge itself: its boards, calls and commands."""
import re
from typing import List, Optional, Sequence, Tuple

from ..watch.calls import Verdict
from ..watch.state import ERROR, OK, BridgeState
from ..watch.table import LEVELS, Heading, TextLine
from ..watch.topics import LINKS, NODE, TOPICS


class Calls:
    """The calls of one service."""

    def __init__(self) -> None:
        self.words = 'not called yet'      # the latest call as text
        self._counts = {verdict: 0 for verdict in Verdict}

    def answered(self, what: str, verdict: Verdict, words: str, seconds: float) -> None:
        """Count a call that ended.

        Args:
            what: the request as text.
            words: describes the outcome; not shown if the call succeeded.
            seconds: the duration of the call.
        """
        self._counts[verdict] += 1
        outcome = verdict.value if verdict is Verdict.DONE else f'{verdict.value}: {words}'
        counts = ', '.join(f'{count} {each.value}' for each, count in self._counts.items()
                           if count or each is Verdict.DONE)
        self.words = f'{what}: {outcome}, after {seconds:.2f} s ({counts})'

    @property
    def succeeded(self) -> bool:
        """Whether at least one call has succeeded."""
        return self._counts[Verdict.DONE] > 0

    @property
    def failed(self) -> bool:
        """Whether calls have ended and none has succeeded."""
        return not self.succeeded and any(self._counts.values())


class PageAddress:
    """The address of the page that the panel has printed.

    Args:
        log: the file that it prints to, among other lines.
    """

    def __init__(self, log: str) -> None:
        self._log = log
        self._read = 0       # bytes of the file
        self._address = ''

    def latest(self) -> str:
        """Return the address; '' if there is none yet."""
        try:
            with open(self._log, 'rb') as file:
                file.seek(self._read)
                new = file.read()
        except OSError:
            return self._address
        complete = new[:new.rfind(b'\n') + 1]
        self._read += len(complete)
        for found in re.finditer(rb'^panel: (http://\S+)$', complete, re.MULTILINE):
            self._address = found.group(1).decode(errors='replace')
        return self._address


class Demo:
    """The state that the demo's table shows.

    Args:
        boards: the kind of boards, for the title.
        links: the links that are on.
        moves: whether lift and gimbal are called.
        setup: the command that sets up a second terminal.
        master: the master's address.
        page: the panel's address; None: there is no panel.
        control: whether the page has commands.
    """

    def __init__(self, boards: str = 'simulated', links: Sequence[str] = LINKS,
                 moves: bool = True, setup: str = '', master: str = '',
                 page: Optional[PageAddress] = None, control: bool = False) -> None:
        self.bridge = BridgeState(NODE, [topic for topic in TOPICS
                                         if set(topic.links) & set(links)], links, master)
        self.calls = {'lift': Calls(), 'gimbal': Calls()} if moves and 'bus' in links else {}
        self.driving = ''            # the latest commands to the car, as text
        self._boards = boards
        self._no_commands = 'none; the page has them' if control \
            else 'none: real boards are not moved'
        self._setup = setup
        self._page = page

    def links_open(self) -> bool:
        """Whether every link has reported an open port, and no board that does not answer."""
        return all(link is not None and link.level < ERROR
                   for link in self.bridge.links.values())

    def refusal(self) -> str:
        """Return why the bridge refuses commands for the car now; '' if it accepts them."""
        calibrating = self.bridge.topic('~imu/calibrating')
        if calibrating and calibrating.message and calibrating.message.data:
            return 'calibrating'
        link = self.bridge.links.get('arduino')
        return 'port closed' if link and link.level == ERROR else ''

    def missing(self) -> List[str]:
        """Return a line for each topic without data and each service without a success."""
        out = [f'no data on {each.topic.name}' for each in self.bridge.topics
               if not each.count and not each.topic.optional]
        return out + [f'no successful answer from {name}: {calls.words}'
                      for name, calls in self.calls.items() if not calls.succeeded]

    def trouble(self) -> List[str]:
        """Return a line for each link whose latest status is not OK."""
        return [f'{name} {LEVELS[link.level]}: {link.summary}'
                for name, link in self.bridge.links.items() if link and link.level != OK]

    def heading(self, elapsed: float, notes: Tuple[TextLine, ...] = ()) -> Heading:
        """Return what is shown around the links and topics, `elapsed` seconds after the start."""
        commands = [TextLine(f'{name:<7} {calls.words}', 'bad' if calls.failed else 'plain')
                    for name, calls in self.calls.items()]
        refusal = self.refusal()
        if self.driving:
            commands.append(TextLine(f'car     speed refused: {refusal}', 'warn') if refusal
                            else TextLine(f'car     {self.driving}'))
        own = [TextLine(words + text, whole=True) for words, text in (
            ('In another terminal:  ', self._setup),
            ('In a browser:  ', self._page.latest() if self._page else '')) if text]
        return Heading(
            (f'{self._boards.capitalize()} boards, {elapsed:.0f} s.', 'Ctrl-C ends the demo.',
             f'~ is {NODE}/'), (*own, *notes),
            tuple(commands) or (TextLine(self._no_commands),))
