"""Computes figures from measured times, and goals and tables from figures. No I/O."""
from bisect import bisect_right
from math import ceil
from typing import Any, Callable, Dict, List, NamedTuple, Sequence, Tuple

from tabulate import tabulate

Figures = Dict[str, float]      # by name; less is better
Results = Dict[str, Figures]    # of one section, by side
CPU, SCHEDSTAT = 'CPU, % of a core', 'CPU by schedstat, % of a core'
# A thread is not shown if none of the compared ones has as much.
_SHOWN = {', ms in 10 s': 5.0, ', wake-ups per packet': 0.05}


def percentile(values: Sequence[float], percent: float) -> float:
    """Return the least value that `percent` % of the values do not exceed."""
    return sorted(values)[max(0, ceil(len(values) * percent / 100) - 1)]


def best(rounds: Sequence[Figures]) -> Figures:
    """Return the least value of each figure."""
    return {name: min(each[name] for each in rounds if name in each)
            for name in {name: None for each in rounds for name in each}}


def latencies(sent: Sequence[Sequence[float]],
              received: Sequence[Sequence]) -> List[float]:
    """Return the latency in s of each packet that was received.

    Args:
        sent: the times at which a turn's packets were written, by the turn's number.
        received: (index of the packet in its turn, the turn's number, time). One that was received
            before it was sent is of an earlier round.
    """
    found = {}
    for packet, number, at, *_ in received:
        if number < len(sent) and at >= sent[number][packet]:
            found.setdefault((packet, number), at - sent[number][packet])
    return list(found.values())


def stamp_errors(measured: Sequence[float],
                 received: Sequence[Sequence]) -> Tuple[List[float], List[float]]:
    """Return how far each stamp is from its measurement, and the distance of each two that follow
    one another from that of their measurements, in s.

    Args:
        measured: the time of each turn.
        received: as for `latencies`, with the stamp behind the time; of one round.
    """
    stamps = {number: stamp for packet, number, _, stamp in received if packet == 0}
    errors = {turn: stamps[turn] - at for turn, at in enumerate(measured) if turn in stamps}
    return ([abs(error) for error in errors.values()],
            [abs(error - errors[turn - 1]) for turn, error in errors.items()
             if turn - 1 in errors])


def gaps_in_queue(exchanges: Sequence[Tuple[float, float]],
                  calls: Sequence[Tuple[float, float, Any]], margin: float) -> List[float]:
    """Return the seconds from a reply's last byte to the next request's first, if a call waited.

    A call waited if more calls had begun, `margin` s before the reply, than there were replies
    up to it.
    """
    begun = sorted(start for start, _, _ in calls)
    return [following[0] - one[1]
            for index, (one, following) in enumerate(zip(exchanges, exchanges[1:]))
            if bisect_right(begun, one[1] - margin) > index + 1]


# -- goals ------------------------------------------------------------------------------------

class Goal(NamedTuple):
    """A goal, which is met if the figure is at most the limit."""

    what: str
    limit: float
    section: str
    measure: Callable[[Results], float]


def _ratio(figure: str, one: str, other: str) -> Callable[[Results], float]:
    return lambda results: results[one][figure] / results[other][figure]


def _of(side: str, figure: str) -> Callable[[Results], float]:
    return lambda results: results[side][figure]


GOALS = (
    Goal('latency p50, relative to polling', 0.20, 'latency',
         _ratio('p50, ms', 'bridge', 'polling')),
    Goal('latency p99, relative to polling', 0.60, 'latency',
         _ratio('p99, ms', 'bridge', 'polling')),
    Goal("heartbeat's standard deviation, relative to polling", 0.5, 'latency',
         _ratio('heartbeat: deviation, ms', 'bridge', 'polling')),
    Goal('heartbeat beside two busy processes, p99.9 in ms', 15, 'busy',
         _of('bridge', 'heartbeat: p99.9, ms')),
    Goal('CPU with subscribers, relative to publishing', 1.25, 'cpu',
         _ratio(CPU, 'bridge', 'publishing')),
    Goal('CPU without subscribers, relative to publishing', 0.35, 'cpu',
         _ratio(CPU, 'bridge, no subscriber', 'publishing')),
    Goal('bus: gap between exchanges while calls wait, p50 in ms', 0.3, 'bus',
         lambda results: max(value for name, value in results['bridge'].items() if 'gap' in name)),
    Goal('1 Mbaud back to back: messages and bytes lost', 0, 'flood',
         lambda results: sum(value for name, value in results['bridge'].items()
                             if 'lost' in name)),
    *(Goal(f"stamps with the board's time, {line}: p99 of the error in ms", limit, 'stamps',
           _of(line, 'board: error p99, ms'))
      for line, limit in (('tty', 0.3), ('1 ms', 0.6), ('16 ms', 2.5))),
    *(Goal(f'stamps of the emulated Nano, {line}: p99 of the error in ms', limit, 'nano',
           _of(line, 'board: error p99, ms')) for line, limit in (('1 ms', 0.6), ('16 ms', 2.5))),
    *(Goal(f'distance of two of them, {line}: p99 in ms', 0.1, 'nano',
           _of(line, 'board: distance p99, ms')) for line in ('1 ms', '16 ms')),
    Goal('distance of two of them, p99 in ms', 0.1, 'stamps',
         lambda results: max(results[line]['board: distance p99, ms']
                             for line in ('tty', '1 ms', '16 ms'))),
    Goal("CPU with the board's time, relative to without", 1.05, 'stamps',
         lambda results: results['tty']['board: ' + SCHEDSTAT]
         / results['tty']['read: ' + SCHEDSTAT]),
    Goal('a setting, from set to confirmed: p99 in ms', 20, 'settings',
         _of('5 sets a second', 'p99, ms')),
    Goal('heartbeat while a slider is dragged, p99.9 in ms', 15, 'settings',
         _of('a slider is dragged', 'heartbeat: p99.9, ms')),
    Goal('CPU of each of several bridges, relative to one', 1.10, 'bridges',
         _ratio(CPU, 'all', 'one')),
)


def goals_against(commit: str) -> Tuple[Goal, ...]:
    """Return the goals of the comparison with another commit."""
    return tuple(Goal(f'{what}, relative to {commit}', 1.10, section,
                      _ratio(figure, 'bridge', commit))
                 for what, section, figure in (
                     ('latency p50', 'latency', 'p50, ms'), ('latency p99', 'latency', 'p99, ms'),
                     ('CPU of the car alone', 'latency', SCHEDSTAT),
                     ('CPU with subscribers', 'cpu', SCHEDSTAT)))


def judge(results: Dict[str, Results], against: str = '') -> List[tuple]:
    """Return (goal, limit, figure, 'met' or 'NOT MET') for each goal of the sections that ran."""
    goals = GOALS + (goals_against(against) if against else ())
    found = [(goal, goal.measure(results[goal.section])) for goal in goals
             if goal.section in results]
    return [(goal.what, goal.limit, value, 'met' if value <= goal.limit else 'NOT MET')
            for goal, value in found]


# -- for users --------------------------------------------------------------------------------

def render(facts: str, results: Dict[str, Results], titles: Dict[str, str], against: str) -> str:
    """Return the whole report.

    Args:
        facts: about the machine.
        titles: of the sections.
        against: the commit with which the bridge is compared, or ''.
    """
    goals = tabulate(judge(results, against), ('goal', 'at most', 'measured', ''), floatfmt='.2f')
    return '\n\n'.join([facts, goals] + [f'{titles[name]}\n{_table(sides, against)}'
                                         for name, sides in results.items()])


def _table(sides: Results, against: str) -> str:
    """The table of a section: a line for each figure, a column for each side."""
    rows = []
    for figure in {name: None for figures in sides.values() for name in figures}:
        values = [figures.get(figure) for figures in sides.values()]
        ours, theirs = sides.get('bridge', {}).get(figure), sides.get(against, {}).get(figure)
        least = next((least for ending, least in _SHOWN.items() if figure.endswith(ending)), None)
        if least is not None and max(ours or 0.0, theirs or 0.0) < least:
            continue
        rows.append([figure, *values, *([ours / theirs if ours and theirs else None]
                                        if against in sides else [])])
    return tabulate(rows, ['', *sides, *([f'bridge / {against}'] if against in sides else [])],
                    floatfmt='.2f')
