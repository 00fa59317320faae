"""The table: a `State`, a pure function from it to lines of text, and the screen they go to."""
import shutil
import sys
from collections import deque
from typing import Any, Deque, Dict, List, NamedTuple, Optional, Tuple

from .topics import LINKS, NODE, TOPICS, Topic

PERIOD = 1.0            # s from one redraw to the next
_PLAIN_EVERY = 5        # redraws to one report, where the output is no terminal
_RATE_WINDOW = 5.0      # s over which a rate is counted
_VALUE_AT = 36          # column of a topic's value


class TopicState:
    """What has come on one topic."""

    def __init__(self, topic: Topic) -> None:
        self.topic = topic
        self.count = 0
        self.rate: Optional[float] = None    # Hz; None: not known yet
        self.words = ''
        self._counted: Deque[Tuple[float, int]] = deque()

    def measure(self, now: float) -> None:
        """To be called at every redraw: the rate over the last few seconds."""
        self._counted.append((now, self.count))
        while now - self._counted[0][0] > _RATE_WINDOW + PERIOD / 2:
            self._counted.popleft()
        began, count = self._counted[0]
        self.rate = (self.count - count) / (now - began) if now > began else None


class LinkState(NamedTuple):
    """What /diagnostics says about one link."""

    level: int
    summary: str
    values: Dict[str, str]


class Call:
    """The latest call of one service."""

    def __init__(self) -> None:
        self.words = 'not called yet'
        self.succeeded = 0
        self.failed = 0


class State:
    """All that the table shows."""

    def __init__(self, boards: str = 'simulated', links: Tuple[str, ...] = LINKS,
                 moves: bool = True, setup: str = '') -> None:
        self.boards = boards
        self.on = links
        self.moves = moves
        self.setup = setup           # the line that a second terminal needs
        self.elapsed = 0.0           # s
        self.topics = [TopicState(topic) for topic in TOPICS if set(topic.links) & set(links)]
        self.links: Dict[str, LinkState] = {}
        self.calls = {'lift': Call(), 'gimbal': Call()} if moves and 'bus' in links else {}
        self.commands = ''           # the latest, to the car

    def missing(self) -> List[str]:
        """What has not been shown to work, in words; empty if everything has."""
        out = ['no data on %s' % each.topic.name for each in self.topics
               if not each.count and not each.topic.optional]
        for name, call in self.calls.items():
            if not call.succeeded:
                out.append('no successful answer from %s: %s' % (name, call.words))
        return out


class Line(NamedTuple):
    """A line of the table, and how it looks: plain, head, good, warn or bad."""

    text: str
    style: str = 'plain'


def layout(state: State, width: int = 80, height: int = 24) -> List[Line]:
    """The table, at most `width` by `height`; blank lines and headings only where there is room."""
    blocks = [[Line('%s boards, %d s.  ~ is /%s/  Ctrl-C ends it.' % (
        state.boards.capitalize(), state.elapsed, NODE), 'head')]]
    if state.setup:
        blocks[0].append(Line('In another terminal:  ' + state.setup))
    shown = [each for each in state.topics if each.count or not each.topic.optional]
    blocks.append([Line('%-24s %9s  %s' % ('topic', 'rate', 'last value'), 'head')])
    blocks[-1] += [_topic_line(each) for each in shown]
    blocks.append([Line('link', 'head')])
    blocks[-1] += [_link_line(name, state.links.get(name)) for name in state.on]
    blocks.append([Line('commands', 'head')])
    blocks[-1] += [Line('%-8s%s' % (name, call.words), 'plain' if call.succeeded or
                        not call.failed else 'bad') for name, call in state.calls.items()]
    if state.commands:
        blocks[-1].append(Line('%-8s%s' % ('car', state.commands)))
    if len(blocks[-1]) == 1:
        blocks[-1].append(Line('none: real boards are only looked at'))
    lines = _stack(blocks, height)
    return [Line(text[:width], style) for text, style in lines[:height]]


def _stack(blocks: List[List[Line]], height: int) -> List[Line]:
    """One below the other, as airy as the height allows; at last two topics share a line."""
    title, topics, links, commands = blocks
    needed = sum(len(block) for block in blocks)
    if needed + 3 <= height:
        gap = [Line('')]
        return title + gap + topics + gap + links + gap + commands
    if needed <= height:
        return title + topics + links + commands
    short = title + topics[1:] + links[1:] + commands[1:]
    for pair in (('/tf', '/tf_static'), ('mcu/range_1', 'mcu/range_2'),
                 ('~environment/temperature', '~environment/humidity')):
        if len(short) > height:
            short = _join(short, pair)
    return short


def _join(lines: List[Line], names: Tuple[str, str]) -> List[Line]:
    """The lines of these two topics, which follow each other, as one line."""
    at = next((index for index, line in enumerate(lines)
               if line.text.split(' ')[0] == names[0]), None)
    if at is None:
        return lines
    one, other = lines[at:at + 2]
    text = '%s, %s%s; %s' % (names[0], names[1].split('/')[-1],
                             one.text[len(names[0]):][len(names[1].split('/')[-1]) + 2:],
                             other.text[_VALUE_AT:])
    return lines[:at] + [Line(text, one.style if one.style != 'plain' else other.style)] \
        + lines[at + 2:]


def _topic_line(each: TopicState) -> Line:
    rate = '-'
    if each.rate:
        rate = '%.1f Hz' % each.rate
    elif each.count == 1:
        rate = 'once'
    elif each.rate == 0.0 and each.count:
        rate = 'paused'
    text = '%-24s %9s  %s' % (each.topic.name, rate, each.words or 'nothing yet')
    return Line(text, 'plain' if each.count else 'warn')


def _link_line(name: str, link: Optional[LinkState]) -> Line:
    if link is None:
        return Line('%-8s no word from it yet' % name, 'warn')
    values = link.values.get
    damaged = sum(int(value) for key, value in link.values.items()
                  if key.endswith(' errors') and value.isdigit())
    parts = ['%-8s%-5s %s' % (name, ('OK', 'WARN', 'ERROR', 'STALE')[min(link.level, 3)],
                              link.summary),
             'in %s' % values('frames received', '-'), 'out %s' % values('frames sent', '-'),
             'bad %d' % damaged]
    for key, words in (('heartbeats sent', 'heartbeats %s'),
                       ('heartbeat max gap [ms]', 'max gap %s ms'),
                       ('timeouts', 'timeouts %s'), ('round trip p50 [ms]', 'round trip %s ms'),
                       ('frames lost', 'lost %s'), ('reconnects', 'reconnects %s')):
        if key in link.values and not (key == 'reconnects' and values(key) == '0'):
            parts.append(words % values(key))
    return Line(', '.join(parts), ('good', 'warn', 'bad', 'bad')[min(link.level, 3)])


def report(state: State) -> List[str]:
    """A few plain lines, where there is no terminal to redraw."""
    wanted = [each for each in state.topics if not each.topic.optional]
    rates = ['%s %.1f Hz' % (each.topic.name, each.rate) for each in wanted
             if each.rate and each.topic.name in ('~imu', '~environment', 'mcu/status')]
    lines = ['[%3d s] %s' % (state.elapsed, ', '.join(['%d of %d topics carry data' % (
        sum(bool(each.count) for each in wanted), len(wanted))] + rates))]
    lines += ['        ' + _link_line(name, state.links.get(name)).text for name in state.on]
    lines += ['        %-8s%s' % (name, call.words) for name, call in state.calls.items()]
    return lines


class Screen:
    """Redraws in place on a terminal; prints a report now and then elsewhere."""

    _STYLES = {'plain': '', 'head': '\033[1m', 'good': '\033[32m', 'warn': '\033[33m',
               'bad': '\033[31m'}

    def __init__(self, out: Any = sys.stdout) -> None:
        self._out = out
        self._terminal = out.isatty()
        self._draws = 0
        if hasattr(out, 'reconfigure'):
            out.reconfigure(errors='replace')    # whatever the locale can print

    def draw(self, state: State) -> None:
        """Show the state as it is now."""
        self._draws += 1
        if self._terminal:
            size = shutil.get_terminal_size()
            # Each line is written over the old one, never wiped first, in one write: no flicker.
            lines = ['%s%s\033[0m\033[K' % (self._STYLES[style], text) for text, style
                     in layout(state, size.columns, size.lines)]
            begin = '\033[?25l\033[2J\033[H' if self._draws == 1 else '\033[H'
            self._write(begin + '\r\n'.join(lines) + '\033[J')
        elif self._draws % _PLAIN_EVERY == 1:
            self._write('\n'.join(report(state)) + '\n')

    def close(self, state: State) -> None:
        """Leave the last table behind and give the terminal back."""
        if self._terminal:
            if self._draws:
                self._write('\033[0m\033[?25h\r\n')
        else:
            lines = layout(state, 160, 100)
            self._write('\n'.join(line.text.rstrip() for line in lines) + '\n')

    def _write(self, text: str) -> None:
        self._out.write(text)
        self._out.flush()
