"""A bridge as a table of text: a pure function from its state to lines, and the screen for them.

Links and calls stand on top, since they tell whether the robot works; where the terminal is too
small, topics are left out from the end, and the table says how many.
"""
import shutil
import sys
from typing import Any, Dict, List, NamedTuple, Optional, Sequence, Tuple, Union

from .state import BridgeState, LinkState, TopicState, ago
from .topics import one_line

PERIOD = 1.0            # s from one redraw to the next
_PLAIN_EVERY = 5        # redraws to one report, where the output is no terminal
_VALUE_AT = 36          # column of a topic's value
LEVELS = ('OK', 'WARN', 'ERROR', 'STALE')

# Topics that share a line before any is left out: they follow each other and say one thing.
_PAIRS = (('/tf', '/tf_static'), ('mcu/range_1', 'mcu/range_2'),
          ('~environment/temperature', '~environment/humidity'))


class Line(NamedTuple):
    """A line of the table, and how it looks: plain, head, good, warn or bad."""

    text: str
    style: str = 'plain'
    whole: bool = False      # to be copied: wraps at the edge, and is never cut

    def rows(self, width: int) -> int:
        """How many rows of the screen it takes."""
        return max(1, -(-len(self.text) // width)) if self.whole else 1


class Frame(NamedTuple):
    """What stands around a bridge's links and topics."""

    title: Tuple[str, ...]           # parts; the last ones are left out where there is no room
    notes: Tuple[Line, ...] = ()     # below the title
    commands: Tuple[Line, ...] = ()  # calls, and what is sent


def layout(bridge: BridgeState, frame: Frame, now: float, width: int = 80,
           height: int = 24) -> List[Line]:
    """The table within `width` by `height`; blank lines and headings where there is room."""
    head = [Line(_fitting(frame.title, '  ', width), 'head')]
    trouble = bridge.trouble(now)
    if trouble:
        head.append(Line(trouble, 'bad'))
    head += frame.notes
    links = [_link_line(name, link, now, width) for name, link in bridge.links.items()]
    commands = list(frame.commands)
    topics = [_topic_line(each, now) for each in bridge.topics
              if each.count or not each.topic.optional]

    blocks = [head, [Line('link', 'head')] + links]
    if commands:
        blocks.append([Line('commands', 'head')] + commands)
    blocks.append([Line(f"{'topic':<24}{'rate':>10}  last value", 'head')] + topics)
    needed = sum(line.rows(width) for block in blocks for line in block)
    if needed + len(blocks) - 1 <= height:
        lines = [line for block in blocks for line in [Line('')] + block][1:]
    elif needed <= height:
        lines = [line for block in blocks for line in block]
    else:
        lines = _crowded(head, links + commands, topics, width, height)
    return [line if line.whole else line._replace(text=_cut(one_line(line.text), width))
            for line in lines]


def _crowded(head: List[Line], first: List[Line], topics: List[Line], width: int,
             height: int) -> List[Line]:
    """Without headings; `first` before `head` before `topics`, where there is no room for all."""
    left = height - len(first)
    shown = []
    for line in head:
        # One row stays free for the number of topics that are left out.
        if line.rows(width) < left or (not topics and line.rows(width) == left):
            shown.append(line)
            left -= line.rows(width)
    for pair in _PAIRS:
        if len(topics) > left:
            topics = _joined(topics, pair)
    if len(topics) > left:
        more = len(topics) - max(0, left - 1)
        topics = topics[:max(0, left - 1)] + [Line(f'… {more} more lines')]
    return (shown + first + topics)[:height]


def _joined(lines: List[Line], names: Tuple[str, str]) -> List[Line]:
    """The lines of these two topics, if they follow each other, as one line."""
    starts = [line.text.split(' ')[0] for line in lines]
    at = starts.index(names[0]) if names[0] in starts else len(lines)
    if starts[at + 1:at + 2] != [names[1]]:
        return lines
    one, other = lines[at:at + 2]
    both = f"{names[0]}, {names[1].split('/')[-1]}"
    text = f'{both:<24} {one.text[25:]}; {other.text[_VALUE_AT:]}'
    if len(both) > 24:      # the rate stays in its column
        text = f'{both} {one.text[25:][len(both) - 24:]}; {other.text[_VALUE_AT:]}'
    return lines[:at] + [Line(text, one.style if one.style != 'plain' else other.style)] \
        + lines[at + 2:]


def _topic_line(each: TopicState, now: float) -> Line:
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
    text = f"{each.topic.name:<24}{rate:>10}  {each.words or 'nothing yet'}"
    return Line(text, 'warn' if stale or not each.count else 'plain')


def _link_line(name: str, link: Optional[LinkState], now: float, width: int) -> Line:
    if link is None:
        return Line(f'{name:<7} no word from it yet', 'warn')
    level = min(link.level, len(LEVELS) - 1)
    parts: List[Union[str, Tuple[str, str]]] = [
        f'{name:<7} {LEVELS[level]:<5} {link.summary}']
    if link.stale(now):
        level = len(LEVELS) - 1
        parts = [f'{name:<7} STALE said {ago(now - link.at)} ago: {link.summary}']
    bad = f'bad {sum(link.errors.values())}'
    causes = ', '.join(f'{count} {cause}' for cause, count in link.errors.items() if count)
    parts.append((f'{bad} ({causes})', bad) if causes else bad)
    for key, words in (('frames received', 'in {}'), ('frames sent', 'out {}'),
                       ('timeouts', 'timeouts {}'), ('round trip p50 [ms]', 'round trip {} ms'),
                       ('heartbeat gap [ms]', 'heartbeat gap {} ms'),
                       ('frames lost', 'lost {}'), ('reconnects', 'reconnects {}')):
        if key in link.values and (key, link.values[key]) != ('reconnects', '0'):
            parts.append(words.format(link.values[key]))
    return Line(_fitting(parts, ', ', width), ('good', 'warn', 'bad', 'bad')[level])


def _fitting(parts: Sequence[Union[str, Tuple[str, str]]], between: str, width: int) -> str:
    """As many of the parts as there is room for, the first in any case.

    Of a pair the second is taken where there is no room for the first.
    """
    text = ''
    for part in parts:
        for form in (part,) if isinstance(part, str) else part:
            longer = text + between + form if text else form
            if not text or len(longer) <= width:
                text = longer
                break
    return text


def _cut(text: str, width: int) -> str:
    return text if len(text) <= width else text[:max(0, width - 1)] + '…'


def report(bridge: BridgeState, frame: Frame, now: float) -> List[str]:
    """A few plain lines, where there is no terminal to redraw."""
    wanted = [each for each in bridge.topics if not each.topic.optional]
    carry = sum(bool(each.count) and not each.stale(now) for each in wanted)
    rates = [f'{each.topic.name} {each.rate:.1f} Hz' for each in wanted
             if each.rate and each.topic.name in ('~imu', '~environment', 'mcu/status')]
    lines = [', '.join([f'{frame.title[0]} {carry} of {len(wanted)} topics carry data'] + rates)]
    trouble = bridge.trouble(now)
    if trouble:
        lines.append(f'    {trouble}')
    lines += ['    ' + _link_line(name, link, now, 120).text
              for name, link in bridge.links.items()]
    return lines + [f'    {line.text}' for line in frame.commands]


def plain(bridge: BridgeState, frame: Frame, now: float) -> str:
    """The whole table without colours, however long it is."""
    lines = layout(bridge, frame, now, 160, 1000)
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

    def draw(self, bridge: BridgeState, frame: Frame, now: float) -> None:
        """Show the state as it is now."""
        self._draws += 1
        if not self.is_terminal:
            if self._draws % _PLAIN_EVERY == 1:
                self.say('\n'.join(report(bridge, frame, now)))
            return
        size = shutil.get_terminal_size()
        # Each line is written over the old one, never wiped first, in one write: no flicker.
        rows = [self._row(line, size.columns)
                for line in layout(bridge, frame, now, size.columns, size.lines)]
        begin = '\033[?25l\033[2J\033[H' if self._draws == 1 else '\033[H'
        self._write(begin + '\r\n'.join(rows) + '\033[J')

    def _row(self, line: Line, width: int) -> str:
        # After a row that is full to the edge the cursor waits on its last character, which
        # wiping the rest of the row would take away.
        full = line.text and len(line.text) % width == 0
        return f"{self._STYLES[line.style]}{line.text}\033[0m{'' if full else chr(27) + '[K'}"

    def say(self, text: str) -> None:
        """Lines of their own, where there is no terminal to redraw."""
        if not self.is_terminal:
            self._write(text + '\n')

    def close(self, bridge: BridgeState, frame: Frame, now: float) -> None:
        """Leave the last table behind and give the terminal back."""
        if not self.is_terminal:
            self._write(plain(bridge, frame, now))
        elif self._draws:
            self._write('\033[0m\033[?25h\r\n')

    def _write(self, text: str) -> None:
        self._out.write(text)
        self._out.flush()
