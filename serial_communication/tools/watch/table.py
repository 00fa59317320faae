"""A bridge as lines of text, and the screen that shows them."""
import os
import shutil
import sys
from typing import List, NamedTuple, Optional

from .state import ERROR, OK, STALE, WARN, BridgeState, LinkState, TopicState, ago
from .topics import one_line

PLAIN = -1     # of a line without a level
LEVELS = ('OK', 'WARN', 'ERROR', 'STALE')
_COLOURS = {OK: '\033[32m', WARN: '\033[33m', ERROR: '\033[31m', STALE: '\033[31m'}

# The key of a link's value in /diagnostics, and its text. It is left out where it is 0 or empty.
_COUNTERS = (('stale', 'dropped {} stale bytes'), ('frames received', 'in {}'),
             ('frames sent', 'out {}'), ('timeouts', 'timeouts {}'),
             ('round trip p50 [ms]', 'round trip {} ms'),
             ('heartbeat gap [ms]', 'heartbeat gap {} ms'), ('frames lost', 'lost {}'),
             ('read delay p50 [ms]', 'read delay {} ms'), ('settings', 'settings {}'),
             ('settings unconfirmed', 'unconfirmed {}'), ('reconnects', 'reconnects {}'))


class Line(NamedTuple):
    """A line of the table; its level gives it a colour."""

    text: str
    level: int = PLAIN


def lines(bridge: BridgeState, now: float) -> List[Line]:
    """The table: links first, since they show whether the robot works."""
    trouble = bridge.trouble(now)
    topics = [each for each in bridge.topics if each.count or not each.topic.optional]
    return [Line(f'Bridge {bridge.node} at {bridge.master}; ~ is {bridge.node}/'),
            *([Line(trouble, ERROR)] if trouble else []),
            *(_link_line(name, link, now) for name, link in bridge.links.items()),
            *(_topic_line(each, now) for each in topics)]


def _link_line(name: str, link: Optional[LinkState], now: float) -> Line:
    if link is None:
        return Line(f'{name:<7} no status received yet', WARN)
    level, summary = min(link.level, STALE), link.summary
    if link.stale(now):
        level, summary = STALE, f'reported {ago(now - link.at)} ago: {summary}'
    causes = ', '.join(f'{count} {cause}' for cause, count in link.errors.items() if count)
    parts = [summary, f'errors {sum(link.errors.values())}' + (f' ({causes})' if causes else '')]
    parts += [words.format(link.values[key]) for key, words in _COUNTERS
              if link.values.get(key, '0') not in ('0', '')]
    return Line(f'{name:<7} {LEVELS[level]:<5} ' + ', '.join(parts), level)


def _topic_line(each: TopicState, now: float) -> Line:
    stale = each.stale(now)
    if stale and each.last_at is not None:
        rate = f'{ago(now - each.last_at)} old'
    elif each.rate:
        rate = f'{each.rate:.1f} Hz'
    else:
        rate = 'once' if each.count == 1 else '-' if each.topic.ages else 'on change'
    return Line(f'{each.topic.name:<24} {rate if each.count else "-":>9}  '
                f'{each.words or "nothing yet"}', WARN if stale or not each.count else PLAIN)


def plain(bridge: BridgeState, now: float) -> str:
    """The table for a file or a pipe."""
    return '\n'.join(one_line(line.text) for line in lines(bridge, now))


class Screen:
    """A terminal, in which each table replaces the one before; what stands above it stays."""

    def __init__(self) -> None:
        self._height = 0      # of the table that is shown
        sys.stdout.reconfigure(errors='replace')    # type: ignore  # a locale may lack characters

    def show(self, table: List[Line]) -> None:
        """Show a table, or as much of it as fits."""
        columns, rows = shutil.get_terminal_size()
        if len(table) >= rows:
            kept = max(rows - 2, 0)
            table = table[:kept] + [Line(f'… {len(table) - kept} more lines')]
        text = f'\033[{self._height}F' * bool(self._height)
        for line in table:
            words = one_line(line.text)
            words = words if len(words) <= columns else words[:columns - 1] + '…'
            colour = '' if os.environ.get('NO_COLOR') else _COLOURS.get(line.level, '')
            # Cleared first: after a full row it would erase the last character.
            text += f'\033[2K{colour}{words}{chr(27) + "[0m" if colour else ""}\n'
        print(text + '\033[J', end='', flush=True)
        self._height = len(table)
