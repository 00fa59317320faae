"""What the bridge and the sleeper log, read while they write it."""
import glob
import os
import re
import time
from collections import deque
from typing import Any, Callable, Deque, Dict, List, Tuple

LATE = 0.01          # s: a wake-up of the sleeper that is later is logged
_LATE_KEPT = 5000    # late wake-ups: those of the last 100 s or more
_LINE = re.compile(r'\[(.*?)\]\[\w+\] (\d{4}-\d\d-\d\d \d\d:\d\d:\d\d),(\d{3}): (.*)')
_VARYING = re.compile(r'"[^"]*"|/\S+|\b(0x)?[0-9a-f]*\d[0-9a-f.]*\b|\b[0-9a-f]{6,}\b')
_PERIOD, _JITTER = 10.0, 0.25     # s between two lines of a cause; of the log's clock
_LINKS = 'bus', 'arduino', 'mcu'


def cause_of(text: str) -> Tuple[str, str]:
    """(link, cause) of a log line: its words without what differs each time."""
    link, _colon, rest = text.partition(': ')
    if link not in _LINKS or rest.startswith('says: '):
        return '', ''
    rest = re.sub(r' \(and \d+ more like it\)$', '', rest)
    rest = re.sub(r'^(speed|steering|LED) .*?refused: ', r'\1 refused: ', rest)
    if re.match(r'(checksum|framing|length|unknown type|implausible|oversize|out of step):', rest):
        rest = rest.split(':')[0]
    return link, _VARYING.sub('#', rest)[:60]


class NewLines:
    """The complete lines that were written to a file since they were last read."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._position = 0

    def read(self) -> List[str]:
        with open(self._path, 'rb') as file:
            file.seek(self._position)
            data = file.read()
        complete = data[:data.rfind(b'\n') + 1]
        self._position += len(complete)
        return complete.decode(errors='replace').splitlines()


class LateWakeUps:
    """The latest entries in the log of the sleeper; older ones are forgotten."""

    def __init__(self, path: str) -> None:
        self._lines = NewLines(path)
        self._entries: Deque[Tuple[float, ...]] = deque(maxlen=_LATE_KEPT)

    def longest(self, since: float) -> float:
        """The longest delay of a wake-up since then, in s."""
        self._entries.extend(tuple(map(float, line.split())) for line in self._lines.read())
        return max((late for due, late in self._entries if due >= since), default=0.0)


class LogCheck:
    """Checks the log files of all bridges in `folder`; `require` adds a requirement."""

    def __init__(self, folder: str, require: Callable[[str, str], Any]) -> None:
        self.folder = folder
        self._rate = require('node', 'at most one log line in 10 s for each cause and link')
        self._faults = require('node', 'no traceback and no stuck link in the log')
        self._files: Dict[str, NewLines] = {}
        self._last: Dict[Tuple[str, str, str], float] = {}     # by file, link and cause
        self._by_bridge = True      # whether the bridge wrote the latest line, not rospy

    def check_new_lines(self) -> None:
        for path in glob.glob(os.path.join(self.folder, 'bridge_*.log')):
            for line in self._files.setdefault(path, NewLines(path)).read():
                self._check_line(path, line)

    def _check_line(self, path: str, line: str) -> None:
        match = _LINE.match(line)
        self._by_bridge = match.group(1) == 'rosout' if match else self._by_bridge
        self._faults.check(not self._by_bridge or not re.search(
            'Traceback|fault in the bridge|the bridge is stuck', line), f'{path}: {line}')
        link, cause = cause_of(match.group(4)) if match else ('', '')
        if not link:
            return
        now = time.mktime(time.strptime(match.group(2), '%Y-%m-%d %H:%M:%S')) \
            + int(match.group(3)) / 1000
        before = self._last.get((path, link, cause), float('-inf'))
        self._last[path, link, cause] = now
        self._rate.check(now - before >= _PERIOD - _JITTER,
                         f'{now - before:.2f} s after the previous one: {line}')
