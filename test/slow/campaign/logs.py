"""What the bridge logs, read while it writes it."""
import glob
import os
import re
import time
from collections import defaultdict
from pathlib import Path
from typing import Any, Callable, Dict, Iterable, List, Tuple

from .requirements import Requirement

_LINE = re.compile(r'\[(.*?)\]\[\w+\] (\d{4}-\d\d-\d\d \d\d:\d\d:\d\d),(\d{3}): (.*)')
_VARYING = re.compile(r'"[^"]*"|/\S+|\b(0x)?[0-9a-f]*\d[0-9a-f.]*\b|\b[0-9a-f]{6,}\b')
# What rospy's handlers print: the colour, the level and the time.
_TERMINAL = re.compile(r'(\x1b\[\d*m)?\[(DEBUG|INFO|WARN|ERROR|FATAL)\] \[|(\x1b\[0m)?$')
# Each text of a board is logged.
_BY_BOARD = re.compile('says: |announces |(the|an) announced row')
_PERIOD, _JITTER = 10.0, 0.25     # s between two lines of a cause; of the log's clock
_LINKS = 'bus', 'arduino', 'mcu'


def cause_of(text: str) -> Tuple[str, str]:
    """(link, cause) of a log line: its words without what differs each time."""
    link, _colon, rest = text.partition(': ')
    if link not in _LINKS or _BY_BOARD.match(rest):
        return '', ''
    rest = re.sub(r' \(and \d+ more like it\)$', '', rest)
    rest = re.sub(r'^(speed|steering|LED) .*?refused: ', r'\1 refused: ', rest)
    if re.match(r'(checksum|framing|length|unknown type|implausible|oversize|out of step):', rest):
        rest = rest.split(':')[0]
    return link, _VARYING.sub('#', rest)[:60]


class LogCheck:
    """Checks the log files and the terminal output of all bridges in `folder`."""

    def __init__(self, folder: str, row: Callable[[str], Requirement]) -> None:
        self.folder = folder
        self._rate = row('at most one log line in 10 s for each cause and link')
        self._faults = row('no traceback and no stuck link in the log')
        self._terminal = row('the terminal shows the log and nothing else')
        self._events = row('what happened is in the log')
        self._read: Dict[str, int] = defaultdict(int)      # bytes of each file
        self._last: Dict[Tuple[str, str, str], float] = {}     # by file, link and cause
        self._by_bridge = True      # whether the bridge wrote the latest line, not rospy

    def check_new_lines(self) -> None:
        for path in glob.glob(os.path.join(self.folder, 'bridge_*')):
            for line in self._new_lines(path):
                if path.endswith('.log'):
                    self._check_line(path, line)
                else:
                    self._terminal.check(_TERMINAL.match(line), f'{path}: {line}')

    def _new_lines(self, path: str) -> List[str]:
        """The complete lines that were written since it was last read."""
        with open(path, 'rb') as file:
            file.seek(self._read[path])
            complete = file.read().rpartition(b'\n')[0]
        self._read[path] += len(complete) + bool(complete)
        return complete.decode(errors='replace').splitlines()

    def find(self, pattern: str) -> List[Any]:
        """What matches in the logs of all bridges until now."""
        return [found for path in sorted(glob.glob(os.path.join(self.folder, 'bridge_*.log')))
                for found in re.findall(pattern, Path(path).read_text(errors='replace'))]

    def check_events(self, bridges: Iterable[int], patterns: Iterable[str]) -> None:
        """Check that the logs of these bridges have a line for each of these patterns."""
        text = ''.join(Path(self.folder, f'bridge_{number}.log').read_text(errors='replace')
                       for number in bridges)
        for pattern in patterns:
            self._events.check(re.search(pattern, text), f'no line matches {pattern}')

    def _check_line(self, path: str, line: str) -> None:
        match = _LINE.match(line)
        self._by_bridge = match.group(1) == 'rosout' if match else self._by_bridge
        self._faults.check(not self._by_bridge or not re.search(
            'Traceback|fault in the bridge|the bridge is stuck', line), f'{path}: {line}')
        link, cause = cause_of(match.group(4)) if match else ('', '')
        if match and 'is a new ROS master' in match.group(4):     # it starts again, in this file
            self._last = {key: at for key, at in self._last.items() if key[0] != path}
        if not link:
            return
        now = time.mktime(time.strptime(match.group(2), '%Y-%m-%d %H:%M:%S'))
        now += int(match.group(3)) / 1000
        before = self._last.get((path, link, cause), float('-inf'))
        self._last[path, link, cause] = now
        self._rate.check(now - before >= _PERIOD - _JITTER, f'{now - before:.2f} s later: {line}')
