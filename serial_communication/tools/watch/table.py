"""A bridge as a table of text: a pure function from its state to lines, and the screen.

Links and calls are on top, since they show whether the robot works. Where the terminal is too
small, the last topics are left out and counted.
"""
import os
import shutil
import sys
from typing import Any, Dict, List, NamedTuple, Optional, Sequence, Tuple

from .state import BridgeState, LinkState, TopicState, ago
from .topics import one_line

PERIOD = 1.0            # s between two redraws
_PLAIN_EVERY = 5        # redraws for each report, if the output is not a terminal
LEVELS = ('OK', 'WARN', 'ERROR', 'STALE')

# The key of a link's value in /diagnostics, and its text.
_COUNTERS = (('stale', 'dropped {} stale bytes'), ('frames received', 'in {}'),
             ('frames sent', 'out {}'), ('timeouts', 'timeouts {}'),
             ('round trip p50 [ms]', 'round trip {} ms'),
             ('heartbeat gap [ms]', 'heartbeat gap {} ms'), ('frames lost', 'lost {}'),
             ('read delay p50 [ms]', 'read delay {} ms'),
             ('settings', 'settings {}'), ('settings unconfirmed', 'unconfirmed {}'),
             ('reconnects', 'reconnects {}'))
# Keys that are shown only if they are not 0 and not empty.
_ONLY_ABOVE_0 = ('stale', 'reconnects', 'settings unconfirmed')


class TextLine(NamedTuple):
    """A line of the table, in a style: plain, head, good, warn or bad."""

    text: str
    style: str = 'plain'
    whole: bool = False      # wraps at the edge and is never cut, since users copy it

    def rows(self, width: int) -> int:
        """Return how many rows of the screen it takes."""
        return max(1, -(-len(self.text) // width)) if self.whole else 1


class Heading(NamedTuple):
    """What is shown around a bridge's links and topics."""

    title: Tuple[str, ...]               # parts; those that do not fit are left out
    notes: Tuple[TextLine, ...] = ()     # below the title
    commands: Tuple[TextLine, ...] = ()  # calls and commands sent


def layout(bridge: BridgeState, heading: Heading, now: float, width: int = 80,
           height: int = 24) -> List[TextLine]:
    """Return the table for `width` by `height` characters.

    Blank lines are left out first, then headings, then topics.
    """
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
    gaps: List[List[TextLine]] = [[TextLine('')], []]
    for gap in gaps:
        lines = [line for block in blocks for line in gap + block][len(gap):]
        if sum(line.rows(width) for line in lines) <= height:
            break
    else:
        lines = _compact(head, links + commands, topics, now, width, height)
    return [line if line.whole else line._replace(text=_cut(one_line(line.text), width))
            for line in lines]


def _compact(head: List[TextLine], first: List[TextLine], topics: List[List[TopicState]],
             now: float, width: int, height: int) -> List[TextLine]:
    """The table without headings. `first` has priority over `head`, and `head` over `topics`."""
    left = height - len(first)
    shown = []
    for line in head:
        # One row stays free for the number of topics that are left out.
        if line.rows(width) < left or (not topics and line.rows(width) == left):
            shown.append(line)
            left -= line.rows(width)
    lines = [_topic_line(each, now) for each in _merge_neighbours(topics, left)]
    if len(lines) > left:
        more = len(lines) - max(0, left - 1)
        lines = lines[:max(0, left - 1)] + [TextLine(f'… {more} more lines')]
    return (shown + first + lines)[:height]


def _merge_neighbours(topics: List[List[TopicState]], most: int) -> List[List[TopicState]]:
    """Let neighbouring topics share a line until there are `most` lines, as far as possible.

    Pairs of the same type go first (both ranges), then pairs under one name (~environment/…).
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
    """The line of one topic or of two. The rate is that of the first."""
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
    # The rate stays in its column unless the names are too long.
    return TextLine(f'{name:<24} {rate:>{max(0, 33 - max(24, len(name)))}}  {words}',
                    'plain' if fresh else 'warn')


def _link_line(name: str, link: Optional[LinkState], now: float, width: int) -> TextLine:
    if link is None:
        return TextLine(f'{name:<7} no status received yet', 'warn')
    level = min(link.level, len(LEVELS) - 1)
    status = f'{name:<7} {LEVELS[level]:<5} {link.summary}'
    if link.stale(now):
        level = len(LEVELS) - 1
        status = f'{name:<7} STALE reported {ago(now - link.at)} ago: {link.summary}'
    errors = f'errors {sum(link.errors.values())}'
    causes = ', '.join(f'{count} {cause}' for cause, count in link.errors.items() if count)
    if causes and len(f'{status}, {errors} ({causes})') <= width:
        errors += f' ({causes})'
    counters = [words.format(link.values[key]) for key, words in _COUNTERS if key in link.values
                and not (key in _ONLY_ABOVE_0 and link.values[key] in ('0', ''))]
    return TextLine(_fitting([status, errors, *counters], ', ', width),
                    ('good', 'warn', 'bad', 'bad')[level])


def _fitting(parts: Sequence[str], between: str, width: int) -> str:
    """Join the first part and each later part that fits into `width` characters."""
    text = parts[0]
    for part in parts[1:]:
        if len(text + between + part) <= width:
            text += between + part
    return text


def _cut(text: str, width: int) -> str:
    return text if len(text) <= width else text[:max(0, width - 1)] + '…'


def report(bridge: BridgeState, heading: Heading, now: float) -> List[str]:
    """Return a few plain lines for an output that is not a terminal, with a rate for each link."""
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
    """Return the whole table without colours, whatever its length."""
    lines = layout(bridge, heading, now, 160, 1000)
    return '\n'.join(line.text.rstrip() for line in lines) + '\n'


class Screen:
    """Redraws the table in place on a terminal; elsewhere prints a report every 5 redraws."""

    _STYLES: Dict[str, str] = {'head': '\033[1m', 'good': '\033[32m',
                               'warn': '\033[33m', 'bad': '\033[31m'}

    def __init__(self, out: Any = None) -> None:
        self._out = sys.stdout if out is None else out
        self.is_terminal = self._out.isatty()
        self._draws = 0
        # Any text turns styles off: see no-color.org.
        self._styles = {} if os.environ.get('NO_COLOR') else self._STYLES
        if hasattr(self._out, 'reconfigure'):
            self._out.reconfigure(errors='replace')    # for characters that the locale lacks

    def draw(self, bridge: BridgeState, heading: Heading, now: float) -> None:
        """Show the state at the time `now`."""
        self._draws += 1
        if not self.is_terminal:
            if self._draws % _PLAIN_EVERY == 1:
                self.say('\n'.join(report(bridge, heading, now)))
            return
        size = shutil.get_terminal_size()
        # One write that overwrites the old lines without clearing them first: no flicker.
        rows = [self._row(line, size.columns)
                for line in layout(bridge, heading, now, size.columns, size.lines)]
        begin = '\033[?25l\033[2J\033[H' if self._draws == 1 else '\033[H'
        self._write(begin + '\r\n'.join(rows) + '\033[J')

    def _row(self, line: TextLine, width: int) -> str:
        # After a full row the cursor stays on its last character, which clearing to the end of
        # the row would erase.
        full = line.text and len(line.text) % width == 0
        style = self._styles.get(line.style, '')
        return f"{style}{line.text}\033[0m{'' if full else chr(27) + '[K'}"

    def say(self, text: str) -> None:
        """Print lines between the reports; nothing on a terminal."""
        if not self.is_terminal:
            self._write(text + '\n')

    def close(self, bridge: BridgeState, heading: Heading, now: float) -> None:
        """Leave the last table on the screen and restore the terminal."""
        if not self.is_terminal:
            self._write(plain(bridge, heading, now))
        elif self._draws:
            self._write('\033[0m\033[?25h\r\n')

    def _write(self, text: str) -> None:
        self._out.write(text)
        self._out.flush()
