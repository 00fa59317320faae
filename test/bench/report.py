"""From measured times to figures, from figures to goals, tables and a plot. Pure."""
from bisect import bisect_right
from statistics import median, pstdev
from typing import Any, Callable, Dict, List, NamedTuple, Optional, Sequence, Tuple

from serial_communication.tools.wire.figures import percentile

from .figures import (BusCalls, Bridges, Cpu, Decoding, GoalRow, Heartbeat, Latency, Load, RowCost,
                      Spread)

_NAN = float('nan')
_RESTED = ('raw', 'mixed')      # before which the node waits, so that no stray reply answers them


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


def over_turns(turns: Sequence[Sequence[float]], scale: float = 1e3) -> Spread:
    """p50 and p99: medians over the turns; p99.9 and max: of all turns together."""
    full = [turn for turn in turns if turn]
    every = [value * scale for turn in full for value in turn]
    if not every:
        return Spread(_NAN, _NAN, _NAN, _NAN, _NAN, 0)
    return Spread(median(percentile(turn, 50) for turn in full) * scale,
                  median(percentile(turn, 99) for turn in full) * scale,
                  percentile(every, 99.9), max(every),
                  median(pstdev(turn) for turn in full) * scale, len(every))


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

Rows = Sequence[Any]      # of one section, see figures.py


class Goal(NamedTuple):
    """One row of the table of goals."""

    what: str
    goal: str
    section: str
    measure: Callable[[Rows], Tuple[float, str]]    # the figure, and how it came about
    met: Callable[[float], bool]


def _worst_ratio(figures: Dict[Tuple[str, str], float]) -> Tuple[float, str]:
    """Of the bridge's to the reference's; `figures` by (link or load, node)."""
    ratios = {key: value / figures[key, 'reference']
              for (key, node), value in figures.items() if node == 'bridge'}
    return max(ratios.values()), ', '.join(f'{key} {value:.2f}' for key, value in ratios.items())


def _latency_ratio(rows: Sequence[Latency], which: str) -> Tuple[float, str]:
    return _worst_ratio({(row.link, row.node): getattr(row.spread, which) for row in rows})


def _heartbeat_ratio(rows: Sequence[Heartbeat]) -> Tuple[float, str]:
    return _worst_ratio({(row.load, row.node): row.spread.deviation for row in rows})


def _heartbeat_gap(rows: Sequence[Heartbeat]) -> Tuple[float, str]:
    busy = {row.node: row.spread.p999 for row in rows if row.load == 'busy'}
    return busy['bridge'], (f"ms; the reference {busy['reference']:.1f}, a bare timer "
                            f"{busy['bare timer']:.1f}")


def _cpu_ratio(rows: Sequence[Cpu], name: str) -> Tuple[float, str]:
    percent = {row.node: row.percent for row in rows}
    return percent[name] / percent['floor'], (f"{percent[name]:.2f} % of a core, the floor "
                                              f"{percent['floor']:.2f} %")


def _bus_gap(rows: Sequence[BusCalls]) -> Tuple[float, str]:
    gaps = {row.request: row.gap.p50 for row in rows if row.wire == 115200}
    shown = ', '.join(f'{name} {gap:.3f}' for name, gap in gaps.items())
    return (max(gap for name, gap in gaps.items() if name not in _RESTED),
            f'ms; {shown} (raw requests wait for a silent line first)')


def _row_ratio(rows: Sequence[RowCost]) -> Tuple[float, str]:
    own = [row for row in rows if row.what == "a row of one's own"][0]
    return own.times, ', '.join(f'{row.what} {row.us_to_ros:.2f} us' for row in rows)


def _lost(rows: Sequence[Load]) -> Tuple[float, str]:
    row = next(row for row in rows if row.link == 'arduino' and row.baud == 1000000)
    return (row.messages_due - row.messages + row.bytes_lost,
            f'{row.messages} of {row.messages_due} messages arrived'
            + (f'; first lost: {row.first_lost}' if row.first_lost else ''))


def _growth(rows: Sequence[Bridges]) -> Tuple[float, str]:
    alone = rows[0].percent_each
    return (max(row.percent_each for row in rows) / alone,
            ', '.join(f'{row.bridges}: {row.percent_each:.2f} % of a core each' for row in rows))


GOALS = (
    Goal('latency p50, against the polling reference', '<= 0.20', 'latency',
         lambda rows: _latency_ratio(rows, 'p50'), lambda x: x <= 0.20),
    Goal('latency p99, likewise', '<= 0.60', 'latency',
         lambda rows: _latency_ratio(rows, 'p99'), lambda x: x <= 0.60),
    Goal('CPU with subscribers, against the rospy floor', '<= 1.25', 'cpu',
         lambda rows: _cpu_ratio(rows, 'bridge'), lambda x: x <= 1.25),
    Goal('CPU with no subscriber at all, against the floor', '<= 0.35', 'cpu',
         lambda rows: _cpu_ratio(rows, 'no subscriber'), lambda x: x <= 0.35),
    Goal("heartbeat standard deviation, against the reference's", '<= 0.5', 'heartbeat',
         _heartbeat_ratio, lambda x: x <= 0.5),
    Goal('heartbeat gap, two busy processes, p99.9', '< 15 ms', 'heartbeat',
         _heartbeat_gap, lambda x: x < 15),
    Goal("bus: a reply's last byte to the next request's first, queue not empty, median",
         '< 0.3 ms', 'bus', _bus_gap, lambda x: x < 0.3),
    Goal("a message of one's own, against a class of its own, without rospy", '<= 1.3', 'rows',
         _row_ratio, lambda x: x <= 1.3),
    Goal('1 Mbaud back to back: lost', 'nothing', 'scale', _lost, lambda x: x == 0),
    Goal('CPU of each of ten bridges, against one alone', '<= 1.10', 'bridges',
         _growth, lambda x: x <= 1.10),
)


def judge(results: Dict[str, Rows]) -> List[GoalRow]:
    """The goals whose section was run; for more than one figure, the worst counts."""
    rows = []
    for goal in GOALS:
        if goal.section in results:
            value, details = goal.measure(results[goal.section])
            rows.append(GoalRow(goal.what, goal.goal, value, bool(goal.met(value)), details))
    return rows


def plain(value: Any) -> Any:
    """The same for JSON: a record as an object, None in place of nan."""
    if hasattr(value, '_asdict'):
        value = value._asdict()
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
        size = abs(value)
        return f'{value:.{0 if size >= 1000 else 2 if size >= 1 else 3}f}'
    return str(value)


def render(facts: Dict[str, Any], goals: Sequence[GoalRow], results: Dict[str, Rows]) -> str:
    """The whole report; `facts` about the machine."""
    parts = [f"{facts['cores']} cores of {facts['processor']}, Linux {facts['kernel']}, Python "
             f"{facts['python']}, rospy {facts['rospy']}; load before: {facts['load before']}; "
             f"{facts.get('stolen %', '?')} % of the CPU taken by the host; real-time priority "
             f"{'' if facts['real-time priority'] else 'not '}allowed"]
    if goals:
        parts.append(table(('', 'goal', 'measured', '', ''), [
            (row.what, row.goal, row.measured, 'met' if row.met else 'NOT MET', row.details)
            for row in goals]))
    parts += [f'{title}\n{table(header, list(map(cells, results[name])))}'
              for name, title, header, cells in _TABLES if name in results]
    return '\n\n'.join(parts)


def _turns(values: Sequence[float]) -> str:
    return ' '.join(f'{value:.2f}' for value in values)


def _decoding_cells(row: Decoding) -> Sequence[Any]:
    return (row.link, row.stream, row.reads, row.package.mb_per_s, row.package.frames_per_s,
            row.package.us_per_frame, row.bytewise.mb_per_s, row.times_as_fast, row.at_best,
            'yes' if row.same_messages
            else f'{row.package.frames}, byte-wise {row.bytewise.frames}')


# Of each section: its name, the table's title and header, and a row's cells.
_TABLES: Sequence[Tuple[str, str, Sequence[str], Callable[[Any], Sequence[Any]]]] = (
    ('latency', "Latency from the board's write to the subscriber's callback, ms",
     ('link', 'node', 'p50', 'p99', 'max', 'messages', 'missing'),
     lambda r: (r.link, r.node, r.spread.p50, r.spread.p99, r.spread.max, r.spread.count,
                r.missing)),
    ('heartbeat', 'Interval between heartbeats as the board sees it, ms; busy: two busy processes',
     ('', 'node', 'p50', 'p99', 'p99.9', 'max', 'deviation', 'intervals'),
     lambda r: (r.load, r.node) + r.spread),
    ('cpu', 'CPU at arduino 100 Hz x 4 packets, mcu 20 Hz, bus 1 Hz, % of a core',
     ('', 'CPU %', 'messages/s', 'each turn'),
     lambda r: (r.node, r.percent, r.messages_per_s, _turns(r.turns))),
    ('bridges', 'CPU of several bridges under one master, each with that traffic, % of a core',
     ('bridges', 'CPU %', 'each', 'messages/s', 'each turn'),
     lambda r: (r.bridges, r.percent, r.percent_each, r.messages_per_s, _turns(r.turns))),
    ('bus', 'Bus, 8 callers at once; gap: from a reply\'s last byte to the next request\'s first; '
     'ms',
     ('wire', 'request', 'requests/s', 'of wire', 'wire %', 'gap p50', 'gap p99', 'gaps',
      'call p50', 'call p99', 'reply to answer', 'failed'),
     lambda r: (r.wire or 'unpaced', r.request, r.requests_per_s, r.wire_requests_per_s,
                r.wire_percent, r.gap.p50, r.gap.p99, r.gap.count, r.call.p50, r.call.p99,
                r.to_answer.p50, r.failed)),
    ('decoders', 'Decoders alone; the last columns: against a byte at a time. At best: if nothing '
     "but the typed messages and the frames' records were built",
     ('link', 'stream', 'reads', 'MB/s', 'frames/s', 'us/frame', 'byte-wise MB/s',
      'times as fast', 'at best', 'same frames'), _decoding_cells),
    ('rows', 'A message from bytes to the bytes of a ROS message, us; times: a class of its own',
     ('', 'decoded', 'to ROS', 'times'),
     lambda r: (r.what, r.us_decoded, r.us_to_ros, r.times)),
    ('scale', 'Back to back; every topic has one subscriber',
     ('link', 'baud', 'load %', 'frames/s', 'messages/s', 'CPU %', 'us/message', 'MB',
      'first lost'),
     lambda r: (r.link, r.baud, r.load_percent, r.frames_per_s, r.messages_per_s, r.cpu_percent,
                r.us_per_message, r.memory_mb, r.first_lost or 'nothing')),
)


def plot(loads: Sequence[Load], path: str) -> None:
    """Cost against load, a small PNG; ImportError without matplotlib."""
    import matplotlib
    matplotlib.use('Agg')
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(5, 3.2), dpi=100)
    for link in ('arduino', 'mcu'):
        rows = sorted((row.messages_per_s, row.cpu_percent, bool(row.first_lost))
                      for row in loads if row.link == link)
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
