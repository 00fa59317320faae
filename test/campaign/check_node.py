"""The node: its memory, log and ports. Pure functions over records (see records.py)."""
import re
from bisect import bisect_right
from typing import Dict, List, Tuple

from .expected import LINKS
from .table import Row

RETURN = 1.5             # s from a port's return to data
_LOG_PERIOD = 10.0       # s from one line of a cause to the next
_LOG_JITTER = 0.25       # s that a log's own clock may be off


def check_level(usage: List[Dict], start: float, settled: float, end: float) -> List[Row]:
    """Memory, threads and open files do not grow once the node has settled.

    Ports and calls come and go, so what counts is the most that there was in each half.
    """
    rows = []
    middle = (settled + end) / 2
    for key, unit, slack in (('memory', ' MB', 4.0), ('threads', '', 4), ('files', '', 6)):
        early = [one[key] for one in usage if settled <= one['t'] < middle]
        later = [one[key] for one in usage if middle <= one['t'] <= end]
        violations = []
        worst = ''
        if early and later:
            growth = max(later) - max(early)
            digits = 1 if unit else 0
            worst = f'at most {max(early):.{digits}f}, then {max(later):.{digits}f}{unit}'
            if growth > slack:
                violations.append((end, f'{key} grew by {growth:.1f}{unit} between the halves of '
                                   f'the time after the first {settled - start:.0f} s'))
        name = {'files': 'open files'}.get(key, key)
        rows.append(Row('node', f'{name} level after the first {settled - start:.0f} s',
                        len(early) + len(later), violations, worst))
    return rows


_LINE = re.compile(r'\[.*?\]\[(\w+)\] (\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3}): (.*)')
_NUMBERS = re.compile(r'\b(0x)?[0-9a-f]*\d[0-9a-f.]*\b|\b[0-9a-f]{6,}\b')


def log_lines(text: str, seconds_of) -> List[Tuple[float, str, str]]:
    """(time, severity, text) of each entry of a rospy log file."""
    found = []
    for line in text.splitlines():
        match = _LINE.match(line)
        if match:
            found.append((seconds_of(match.group(2)), match.group(1), match.group(3)))
    return found


def cause_of(text: str) -> Tuple[str, str]:
    """(link, cause) of a line of the bridge's: its words without what differs each time."""
    link, _colon, rest = text.partition(': ')
    if link not in LINKS:
        return '', _NUMBERS.sub('#', text)[:80]
    rest = re.sub(r' \(and \d+ more like it\)$', '', rest)
    rest = re.sub(r'/\S+', '#', rest)      # a path may be longer than what is compared
    if rest.startswith(('checksum', 'framing', 'length', 'unknown type', 'implausible',
                        'oversize', 'out of step')):
        return link, rest.split(':')[0]
    rest = re.sub(r'^no reply to ".*" within', 'no reply within', rest)
    rest = re.sub(r'^(speed|steering|LED) .*?refused: (.*)', r'\1 refused: \2', rest)
    return link, _NUMBERS.sub('#', rest)[:60]


def check_log(lines: List[Tuple[float, str, str]]) -> List[Row]:
    """No cause more than one line in 10 s per link; nothing that is a fault of the bridge's."""
    last: Dict[Tuple[str, str], float] = {}
    violations, faults, closest = [], [], 1e9
    tries = said = 0
    for t, _severity, text in lines:
        if 'Traceback' in text or 'fault in the bridge' in text or 'the bridge is stuck' in text:
            faults.append((t, text[:200]))
        if text.startswith('arduino says: '):
            said += 1
            continue
        link, cause = cause_of(text)
        if not link:
            continue
        tries += 1
        if (link, cause) in last:
            gap = t - last[link, cause]
            closest = min(closest, gap)
            if gap < _LOG_PERIOD - _LOG_JITTER:
                violations.append((t, f'{gap:.2f} s after the one before: {text[:150]}'))
        last[link, cause] = t
    return [Row('node', 'no cause has more than one log line in 10 s per link', tries, violations,
                f'{closest:.1f} s apart' if closest < 1e9 else '',
                note=f"the board's own log lines, {said} of them, have a limit of their own"
                if said else ''),
            Row('node', 'no traceback, no link that gets stuck', len(lines), faults)]


def check_returns(link: str, returns: List[Tuple[float, float]], data: List[float]) -> Row:
    """Data flows again soon after a port's return.

    Args:
        returns: (when it came back and the board was there, until when it stayed).
        data: when frames of this link were taken in, in order.
    """
    tries, worst, violations = 0, 0.0, []
    for back, until in returns:
        if until - back < RETURN:
            continue
        tries += 1
        at = bisect_right(data, back)
        took = data[at] - back if at < len(data) else 1e9
        worst = max(worst, took)
        if took > RETURN:
            violations.append((back, 'no data for ' + (
                f'{took:.2f} s' if took < 1e9 else 'good')))
    return Row('ports', f"data of the {link} link within 1.5 s of its port's return", tries,
               violations, f'{worst:.2f} s' if tries and worst < 1e9 else '')
