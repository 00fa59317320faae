"""What the bridge logs, read as it is written."""
import glob
import os
import re
import time
from typing import Any, Callable, Dict, Tuple

_LINE = re.compile(r'\[(.*?)\]\[\w+\] (\d{4}-\d\d-\d\d \d\d:\d\d:\d\d),(\d{3}): (.*)')
_CHANGING = re.compile(r'"[^"]*"|/\S+|\b(0x)?[0-9a-f]*\d[0-9a-f.]*\b|\b[0-9a-f]{6,}\b')
_PERIOD, _JITTER = 10.0, 0.25     # s from one line of a cause to the next; of the log's clock
_LINKS = 'bus', 'arduino', 'mcu'


def cause_of(text: str) -> Tuple[str, str]:
    """(link, cause) of a line: its words without what differs each time."""
    link, _colon, rest = text.partition(': ')
    if link not in _LINKS or rest.startswith('says: '):
        return '', ''
    rest = re.sub(r' \(and \d+ more like it\)$', '', rest)
    rest = re.sub(r'^(speed|steering|LED) .*?refused: ', r'\1 refused: ', rest)
    if re.match(r'(checksum|framing|length|unknown type|implausible|oversize|out of step):', rest):
        rest = rest.split(':')[0]
    return link, _CHANGING.sub('#', rest)[:60]


class LogWatch:
    """The log files of a campaign's bridges, one each, in `folder`; `row` makes a row."""

    def __init__(self, folder: str, row: Callable[[str, str], Any]) -> None:
        self.folder = folder
        self._rate = row('node', 'no cause has more than one log line in 10 s per link')
        self._fault = row('node', 'no traceback, no link that gets stuck')
        self._read: Dict[str, int] = {}                        # bytes of each file
        self._last: Dict[Tuple[str, str, str], float] = {}     # by file, link and cause
        self._own = True        # whether the bridge wrote the latest line, not rospy

    def look(self) -> None:
        """Judge the lines that have come since."""
        for path in glob.glob(os.path.join(self.folder, 'bridge_*.log')):
            with open(path, 'rb') as file:
                file.seek(self._read.get(path, 0))
                lines = file.read()
            end = lines.rfind(b'\n') + 1
            self._read[path] = self._read.get(path, 0) + end
            for line in lines[:end].decode(errors='replace').splitlines():
                self._line(path, line)

    def _line(self, path: str, line: str) -> None:
        match = _LINE.match(line)
        self._own = match.group(1) == 'rosout' if match else self._own
        self._fault.check(not self._own or not re.search(
            'Traceback|fault in the bridge|the bridge is stuck', line), f'{path}: {line}')
        link, cause = cause_of(match.group(4)) if match else ('', '')
        if not link:
            return
        now = time.mktime(time.strptime(match.group(2), '%Y-%m-%d %H:%M:%S')) \
            + int(match.group(3)) / 1000
        before = self._last.get((path, link, cause), float('-inf'))
        self._last[path, link, cause] = now
        self._rate.check(now - before >= _PERIOD - _JITTER,
                         f'{now - before:.2f} s after the one before: {line}')
