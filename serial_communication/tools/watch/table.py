"""A bridge as a table of text: a pure function from its state to lines, and the screen for them.

Links and calls stand on top, since they tell whether the robot works; where the terminal is too
small, topics are left out from the end, and the table says how many.
"""
import shutil
import sys
from typing import Any, Dict, List, NamedTuple, Optional, Sequence, Tuple

from .state import BridgeState, LinkState, TopicState, ago
from .topics import one_line

PERIOD = 1.0            # s from one redraw to the next
_PLAIN_EVERY = 5        # redraws to one report, where the output is no terminal
LEVELS = ('OK', 'WARN', 'ERROR', 'STALE')

# Of a link's values in /diagnostics, and in words.
_COUNTERS = (('stale', 'dropped {} stale bytes'), ('frames received', 'in {}'),
             ('frames sent', 'out {}'), ('timeouts', 'timeouts {}'),
             ('round trip p50 [ms]', 'round trip {} ms'),
             ('heartbeat gap [ms]', 'heartbeat gap {} ms'), ('frames lost', 'lost {}'),
             ('reconnects', 'reconnects {}'))
_ONLY_ABOVE_0 = ('stale', 'reconnects')     # of these


class TextLine(NamedTuple):
    """A line of the table, and how it looks: plain, head, good, warn or bad."""

    text: str
    style: str = 'plain'
    whole: bool = False      # to be copied: wraps at the edge, and is never cut

    def rows(self, width: int) -> int:
        """How many rows of the screen it takes."""
        return max(1, -(-len(self.text) // width)) if self.whole else 1


class Heading(NamedTuple):
    """What stands around a bridge's links and topics."""

    title: Tuple[str, ...]               # parts; the last ones are left out where there is no room
    notes: Tuple[TextLine, ...] = ()     # below the title
    commands: Tuple[TextLine, ...] = ()  # calls, and what is sent


def layout(bridge: BridgeState, heading: Heading, now: float, width: int = 80,
           height: int = 24) -> List[TextLine]:
    """The table within `width` by `height`; blank lines and headings where there is room."""
    head = [TextLine(_fitting(heading.title, '  ', width), 'head')]
    trouble = bridge.trouble(now)
    head += [TextLine(trouble, 'bad')] if trouble else []
    head += heading.notes
    links = [_link_line(name, link, now, width) for name, link in bridge.links.items()]
    commands = list(heading.commands)
    topics = [[each] for each in bridge.topics if each.count or not each.topic.optional]

    blocks = [head, [TextLine('link', 'head')] + links]
    if commands:
        blocks.append([TextLine('commands', 'head')] + commands)
    blocks.append([TextLine(f"{'topic':<24}{'rate':>10}  last value", 'head')]
                  + [_topic_line(each, now) for each in topics])
    for gap in [TextLine('')], []:
        lines = [line for block in blocks for line in gap + block][len(gap):]
        if sum(line.rows(width) for line in lines) <= height:
            break
    else:
        lines = _crowded(head, links + commands, topics, now, width, height)
    return [line if line.whole else line._replace(text=_cut(one_line(line.text), width))
            for line in lines]


def _crowded(head: List[TextLine], first: List[TextLine], topics: List[List[TopicState]],
             now: float, width: int, height: int) -> List[TextLine]:
    """Without headings; `first` before `head` before `topics`, where there is no room for all."""
    left = height - len(first)
    shown = []
    for line in head:
        # One row stays free for the number of topics that are left out.
        if line.rows(width) < left or (not topics and line.rows(width) == left):
            shown.append(line)
            left -= line.rows(width)
    lines = [_topic_line(each, now) for each in _joined(topics, left)]
    if len(lines) > left:
        more = len(lines) - max(0, left - 1)
        lines = lines[:max(0, left - 1)] + [TextLine(f'… {more} more lines')]
    return (shown + first + lines)[:height]


def _joined(topics: List[List[TopicState]], most: int) -> List[List[TopicState]]:
    """At most so many lines of topics, as far as neighbours can share one.

    Two of one type do first (both ranges), then two below one name (~environment/…).
    """
    topics = list(topics)
    for alike in (lambda each: each.topic.type, lambda each: each.topic.name.rpartition('/')[0]):
        at = 1
        while at < len(topics) > most:
            one, other = topics[at - 1:at + 1]
            if len(one) == len(other) == 1 and alike(one[0]) == alike(other[0]) != '':
                topics[at - 1:at + 1] = [one + other]
            at += 1
    return topics


def _topic_line(group: List[TopicState], now: float) -> TextLine:
    """One topic, or two; the rate is the first one's."""
    each = group[0]
    stale = each.stale(now)
    if not each.count:
        rate = '-'
    elif stale:
        rate = f'{ago(each.age(now) or 0.0)} old'
    elif each.rate:
        rate = f'{each.rate:.1f} Hz'
    elif each.count == 1:
        rate = 'once'
    else:
        rate = '-' if each.topic.ages else 'on change'
    name = ', '.join([each.topic.name] + [other.topic.name.split('/')[-1] for other in group[1:]])
    words = '; '.join(each.words or 'nothing yet' for each in group)
    fresh = all(each.count and not each.stale(now) for each in group)
    # The rate stays in its column, as far as the names leave room.
    return TextLine(f'{name:<24} {rate:>{max(0, 33 - max(24, len(name)))}}  {words}',
                    'plain' if fresh else 'warn')


def _link_line(name: str, link: Optional[LinkState], now: float, width: int) -> TextLine:
    if link is None:
        return TextLine(f'{name:<7} no word from it yet', 'warn')
    level = min(link.level, len(LEVELS) - 1)
    said = f'{name:<7} {LEVELS[level]:<5} {link.summary}'
    if link.stale(now):
        level = len(LEVELS) - 1
        said = f'{name:<7} STALE said {ago(now - link.at)} ago: {link.summary}'
    bad = f'bad {sum(link.errors.values())}'
    causes = ', '.join(f'{count} {cause}' for cause, count in link.errors.items() if count)
    if causes and len(f'{said}, {bad} ({causes})') <= width:
        bad += f' ({causes})'
    counters = [words.format(link.values[key]) for key, words in _COUNTERS if key in link.values
                and not (key in _ONLY_ABOVE_0 and link.values[key] == '0')]
    return TextLine(_fitting([said, bad, *counters], ', ', width),
                    ('good', 'warn', 'bad', 'bad')[level])


def _fitting(parts: Sequence[str], between: str, width: int) -> str:
    """The first part, and as many of the others as there is room for."""
    text = parts[0]
    for part in parts[1:]:
        if len(text + between + part) <= width:
            text += between + part
    return text


def _cut(text: str, width: int) -> str:
    return text if len(text) <= width else text[:max(0, width - 1)] + '…'


def report(bridge: BridgeState, heading: Heading, now: float) -> List[str]:
    """A few plain lines, where there is no terminal to redraw; a rate for each link."""
    wanted = [each for each in bridge.topics if not each.topic.optional]
    carry = sum(bool(each.count) and not each.stale(now) for each in wanted)
    first = {each.topic.links: each for each in reversed(wanted)}
    rates = [f'{each.topic.name} {each.rate:.1f} Hz'
             for each in (first.get((link,)) for link in bridge.links) if each and each.rate]
    lines = [', '.join([f'{heading.title[0]} {carry} of {len(wanted)} topics carry data'] + rates)]
    below = [bridge.trouble(now)] + [
        _link_line(name, link, now, 120).text for name, link in bridge.links.items()]
    return lines + [f'    {text}' for text in below if text] \
        + [f'    {line.text}' for line in heading.commands]


def plain(bridge: BridgeState, heading: Heading, now: float) -> str:
    """The whole table without colours, however long it is."""
    lines = layout(bridge, heading, now, 160, 1000)
    return '\n'.join(line.text.rstrip() for line in lines) + '\n'


class Screen:
    """Redraws in place on a terminal; prints a report now and then elsewhere."""

    _STYLES: Dict[str, str] = {'plain': '', 'head': '\033[1m', 'good': '\033[32m',
                               'warn': '\033[33m', 'bad': '\033[31m'}

    def __init__(self, out: Any = None) -> None:
        self._out = sys.stdout if out is None else out
        self.is_terminal = self._out.isatty()
        self._draws = 0
        if hasattr(self._out, 'reconfigure'):
            self._out.reconfigure(errors='replace')    # whatever the locale can print

    def draw(self, bridge: BridgeState, heading: Heading, now: float) -> None:
        """Show the state as it is now."""
        self._draws += 1
        if not self.is_terminal:
            if self._draws % _PLAIN_EVERY == 1:
                self.say('\n'.join(report(bridge, heading, now)))
            return
        size = shutil.get_terminal_size()
        # Each line is written over the old one, never wiped first, in one write: no flicker.
        rows = [self._row(line, size.columns)
                for line in layout(bridge, heading, now, size.columns, size.lines)]
        begin = '\033[?25l\033[2J\033[H' if self._draws == 1 else '\033[H'
        self._write(begin + '\r\n'.join(rows) + '\033[J')

    def _row(self, line: TextLine, width: int) -> str:
        # After a row that is full to the edge the cursor waits on its last character, which
        # wiping the rest of the row would take away.
        full = line.text and len(line.text) % width == 0
        return f"{self._STYLES[line.style]}{line.text}\033[0m{'' if full else chr(27) + '[K'}"

    def say(self, text: str) -> None:
        """Lines of their own, where there is no terminal to redraw."""
        if not self.is_terminal:
            self._write(text + '\n')

    def close(self, bridge: BridgeState, heading: Heading, now: float) -> None:
        """Leave the last table behind and give the terminal back."""
        if not self.is_terminal:
            self._write(plain(bridge, heading, now))
        elif self._draws:
            self._write('\033[0m\033[?25h\r\n')

    def _write(self, text: str) -> None:
        self._out.write(text)
        self._out.flush()
