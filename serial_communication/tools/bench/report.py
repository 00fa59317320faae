"""From measured times to figures, from figures to goals, tables and a plot. Pure."""
from bisect import bisect_right
from statistics import median, pstdev
from typing import Any, Callable, Dict, List, NamedTuple, Optional, Sequence, Tuple


def percentile(values: Sequence[float], percent: float) -> float:
    """The smallest of the values that `percent` % of them do not exceed; nan without any."""
    if not values:
        return float('nan')
    ordered = sorted(values)
    rank = -(-len(ordered) * percent // 100)       # rounded up
    return ordered[max(0, int(rank) - 1)]


def match(sent: Sequence[Tuple[int, float]], received: Sequence[Tuple[int, float]],
          modulus: int) -> Tuple[List[float], int]:
    """Latencies in s, and how many of the sent did not arrive.

    What is received holds the sent number modulo `modulus`; it belongs to the latest one sent
    before it that fits.
    """
    by_number: Dict[int, List[float]] = {}
    for number, at in sent:
        by_number.setdefault(number % modulus, []).append(at)
    latencies = []
    for number, at in received:
        times = by_number.get(number, [])
        index = bisect_right(times, at) - 1
        if index >= 0:
            latencies.append(at - times.pop(index))
    return latencies, sum(map(len, by_number.values()))


def over_turns(turns: Sequence[Sequence[float]], scale: float = 1e3) -> Dict[str, float]:
    """p50 and p99: medians over the turns; p99.9 and max: of all turns together."""
    full = [turn for turn in turns if turn]
    every = [value for turn in full for value in turn]
    return {
        'p50': median([percentile(turn, 50) for turn in full]) * scale if full else float('nan'),
        'p99': median([percentile(turn, 99) for turn in full]) * scale if full else float('nan'),
        'p99.9': percentile(every, 99.9) * scale,
        'max': max(every) * scale if every else float('nan'),
        'deviation': median([pstdev(turn) for turn in full]) * scale if full else float('nan'),
        'count': len(every),
    }


def queue_gaps(exchanges: Sequence[Tuple[int, float, float, int]],
               calls: Sequence[Tuple[float, float, Optional[int]]],
               margin: float) -> Tuple[List[float], List[float]]:
    """From a reply's last byte to the next request's first: (queue not empty, empty or unsure).

    The queue is known not to be empty at a reply if more calls had begun, `margin` s before it,
    than there are replies up to it.
    """
    begun = sorted(start for start, _, _ in calls)
    busy, unsure = [], []
    for index, (one, following) in enumerate(zip(exchanges, exchanges[1:])):
        waiting = bisect_right(begun, one[2] - margin) > index + 1
        (busy if waiting else unsure).append(following[1] - one[2])
    return busy, unsure


# -- goals ------------------------------------------------------------------------------------

class Goal(NamedTuple):
    """One row of the table of goals."""

    what: str
    goal: str
    section: str
    measure: Callable[[Dict[str, Any]], Tuple[float, str]]    # the figure, and how it came about
    met: Callable[[float], bool]


def _ratios(section: Dict[str, Any], key: str) -> Tuple[float, str]:
    ratios = {link: row['bridge'][key] / row['reference'][key]
              for link, row in section['links'].items()}
    return max(ratios.values()), ', '.join('%s %.2f' % item for item in ratios.items())


def _heartbeat_ratio(section: Dict[str, Any]) -> Tuple[float, str]:
    ratios = {name: section[name]['bridge']['deviation'] / section[name]['reference']['deviation']
              for name in ('idle', 'busy')}
    return max(ratios.values()), 'idle %.2f, busy %.2f' % (ratios['idle'], ratios['busy'])


def _heartbeat_gap(section: Dict[str, Any]) -> Tuple[float, str]:
    busy = section['busy']
    return busy['bridge']['p99.9'], 'ms; the reference %.1f, a bare timer %.1f' % (
        busy['reference']['p99.9'], busy['bare timer']['p99.9'])


def _cpu(name: str) -> Callable[[Dict[str, Any]], Tuple[float, str]]:
    def measure(section):
        one, floor = section[name]['CPU %'], section['floor']['CPU %']
        return one / floor, '%.2f %% of a core, the floor %.2f %%' % (one, floor)
    return measure


def _bus_gap(section: Dict[str, Any]) -> Tuple[float, str]:
    gaps = {row['callers']: row['gap, queue not empty']['p50'] for row in section['rows']
            if row['wire'] == 115200}
    # Before what must not be sent twice the node lets the line rest a while, on purpose.
    rested = ('raw', 'mixed')
    return max(gap for name, gap in gaps.items() if name not in rested), 'ms; ' + ', '.join(
        '%s %.3f' % item for item in gaps.items()) + ' (raw requests wait for a silent line first)'


def _decoders(section: Dict[str, Any]) -> Tuple[float, str]:
    def times(reads):
        return {row['link']: row['times as fast'] for row in section['rows']
                if row['stream'] == 'clean' and row['reads'] == reads}

    large, single = times(4096), times('a frame')
    best = {row['link']: row['at best'] for row in section['rows']
            if row['stream'] == 'clean' and row['reads'] == 4096}
    return min(large.values()), '; '.join(
        '%s %s' % (name, ', '.join('%s %.1f' % item for item in values.items()))
        for name, values in (('large reads:', large), ('a frame a read:', single), (
            'if nothing but the messages and records were built:', best)))


def _lost(section: Dict[str, Any]) -> Tuple[float, str]:
    row = next(row for row in section['rows']
               if row['link'] == 'arduino' and row['baud'] == 1000000)
    text = '%d of %d messages arrived' % (row['messages'], row['messages due'])
    return row['messages due'] - row['messages'] + row['bytes lost'], text + (
        '; first lost: %s' % row['first lost'] if row['first lost'] else '')


GOALS = (
    Goal('latency p50, against the polling reference', '<= 0.20', 'latency',
         lambda s: _ratios(s, 'p50'), lambda x: x <= 0.20),
    Goal('latency p99, likewise', '<= 0.60', 'latency',
         lambda s: _ratios(s, 'p99'), lambda x: x <= 0.60),
    Goal('CPU with subscribers, against the rospy floor', '<= 1.25', 'cpu',
         _cpu('bridge'), lambda x: x <= 1.25),
    Goal('CPU with no subscriber at all, against the floor', '<= 0.35', 'cpu',
         _cpu('no subscriber'), lambda x: x <= 0.35),
    Goal("heartbeat standard deviation, against the reference's", '<= 0.5', 'heartbeat',
         _heartbeat_ratio, lambda x: x <= 0.5),
    Goal('heartbeat gap, two busy processes, p99.9', '< 15 ms', 'heartbeat',
         _heartbeat_gap, lambda x: x < 15),
    Goal("bus: a reply's last byte to the next request's first, queue not empty, median",
         '< 0.3 ms', 'bus', _bus_gap, lambda x: x < 0.3),
    Goal('decoders against byte-at-a-time, clean', '>= 5', 'decoders',
         _decoders, lambda x: x >= 5),
    Goal('1 Mbaud back to back: lost', 'nothing', 'scale', _lost, lambda x: x == 0),
)


def judge(results: Dict[str, Any]) -> List[Dict[str, Any]]:
    """The goals whose section was run; for more than one figure, the worst counts."""
    rows = []
    for goal in GOALS:
        if goal.section in results:
            value, details = goal.measure(results[goal.section])
            rows.append({'what': goal.what, 'goal': goal.goal, 'measured': value,
                         'details': details, 'met': bool(goal.met(value))})
    return rows


def plain(value: Any) -> Any:
    """The same with None in place of nan, which JSON does not have."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and value != value else value


# -- for people -------------------------------------------------------------------------------

def table(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Columns as wide as they need, numbers to the right, texts to the left."""
    cells = [[_cell(value) for value in row] for row in rows]
    widths = [max(len(row[column]) for row in [list(header)] + cells)
              for column in range(len(header))]
    right = [bool(rows) and all(isinstance(row[column], (int, float, type(None)))
                                for row in rows) for column in range(len(header))]

    def line(texts):
        return '  '.join(text.rjust(width) if to_right else text.ljust(width)
                         for text, width, to_right in zip(texts, widths, right)).rstrip()
    return '\n'.join([line(header), '  '.join('-' * width for width in widths)]
                     + [line(row) for row in cells])


def _cell(value: Any) -> str:
    if value is None:
        return '-'
    if isinstance(value, float):
        return '%.0f' % value if abs(value) >= 1000 else '%.2f' % value if abs(
            value) >= 1 else '%.3f' % value
    return str(value)


def render(results: Dict[str, Any]) -> str:
    """The whole report."""
    facts = results['machine']
    parts = ['%d cores of %s, Linux %s, Python %s, rospy %s; load before: %s; %s %% of the CPU '
             'taken by the host; real-time priority %sallowed' % (
                 facts['cores'], facts['processor'], facts['kernel'], facts['python'],
                 facts['rospy'], facts['load before'], facts.get('stolen %', '?'),
                 '' if facts['real-time priority'] else 'not ')]
    goals = results['goals']
    if goals:
        parts.append(table(('', 'goal', 'measured', '', ''), [
            (row['what'], row['goal'], row['measured'], 'met' if row['met'] else 'NOT MET',
             row['details']) for row in goals]))
    for name, write in (('latency', _latency), ('heartbeat', _heartbeats), ('cpu', _cpus),
                        ('bus', _bus), ('decoders', _decoder_rows), ('scale', _scale)):
        if name in results:
            parts.append(write(results[name]))
    return '\n\n'.join(parts)


def _latency(section: Dict[str, Any]) -> str:
    rows = [(link, side, values['p50'], values['p99'], values['max'], values['count'],
             values['unmatched'])
            for link, sides in section['links'].items() for side, values in sides.items()]
    return "Latency from the board's write to the subscriber's callback, ms\n" + table(
        ('link', 'node', 'p50', 'p99', 'max', 'messages', 'missing'), rows)


def _heartbeats(section: Dict[str, Any]) -> str:
    rows = [(name, side, values['p50'], values['p99'], values['p99.9'], values['max'],
             values['deviation'], values['count'])
            for name, sides in section.items() for side, values in sides.items()]
    return 'Interval between heartbeats as the board sees it, ms; busy: two busy processes\n' \
        + table(('', 'node', 'p50', 'p99', 'p99.9', 'max', 'deviation', 'intervals'), rows)


def _cpus(section: Dict[str, Any]) -> str:
    rows = [(name, values['CPU %'], values['messages/s'], values['CPU % of each turn'])
            for name, values in section.items()]
    return 'CPU at arduino 100 Hz x 4 packets, mcu 20 Hz, bus 1 Hz, % of a core\n' + table(
        ('', 'CPU %', 'messages/s', 'each turn'), rows)


def _bus(section: Dict[str, Any]) -> str:
    rows = []
    for row in section['rows']:
        gap, trip = row['gap, queue not empty'], row['round trip']
        rows.append((row['wire'] or 'unpaced', row['callers'], row['requests/s'],
                     row['requests/s of the wire'], row['share of the wire %'], gap['p50'],
                     gap['p99'], gap['count'], trip['p50'], trip['p99'],
                     row['to the answer']['p50'], row['failed']))
    return ('Bus, %d callers at once; gap: from a reply\'s last byte to the next request\'s first; '
            'ms\n' % section['callers']) + table(
        ('wire', 'request', 'requests/s', 'of wire', 'wire %', 'gap p50', 'gap p99', 'gaps',
         'call p50', 'call p99', 'reply to answer', 'failed'), rows)


def _decoder_rows(section: Dict[str, Any]) -> str:
    rows = [(row['link'], row['stream'], str(row['reads']), row['package']['MB/s'],
             row['package']['frames/s'], row['package']['us/frame'], row['bytewise']['MB/s'],
             row['times as fast'], row['at best'], 'yes' if row['same messages'] else
             '%d, byte-wise %d' % (row['package']['frames'], row['bytewise']['frames']))
            for row in section['rows']]
    return ('Decoders alone; the last columns: against a byte at a time. At best: if nothing but '
            "the typed messages and the frames' records were built\n") + table(
        ('link', 'stream', 'reads', 'MB/s', 'frames/s', 'us/frame', 'byte-wise MB/s',
         'times as fast', 'at best', 'same frames'), rows)


def _scale(section: Dict[str, Any]) -> str:
    rows = [(row['link'], row['baud'], row['load %'], row['frames/s'], row['messages/s'],
             row['CPU %'], row['us/message'], row['memory']['MB'],
             row['first lost'] or 'nothing') for row in section['rows']]
    return 'Back to back; every topic has one subscriber\n' + table(
        ('link', 'baud', 'load %', 'frames/s', 'messages/s', 'CPU %', 'us/message', 'MB',
         'first lost'), rows)


def plot(section: Dict[str, Any], path: str) -> None:
    """Cost against load, a small PNG; ImportError without matplotlib."""
    import matplotlib
    matplotlib.use('Agg')
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(5, 3.2), dpi=100)
    for link in ('arduino', 'mcu'):
        rows = sorted((row['messages/s'], row['CPU %'], bool(row['first lost']))
                      for row in section['rows'] if row['link'] == link)
        if rows:
            axes.plot([row[0] for row in rows], [row[1] for row in rows], marker='o',
                      markersize=4, label=link)
            lossy = [row for row in rows if row[2]]
            axes.plot([row[0] for row in lossy], [row[1] for row in lossy], 'rx', markersize=9)
    axes.plot([], [], 'rx', label='something lost')
    axes.set_xlabel('messages published per second')
    axes.set_ylabel('CPU, % of a core')
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path)
