"""The heartbeat, as the model car saw it. Pure functions over records (see records.py)."""
from bisect import bisect_right
from typing import Dict, List, NamedTuple, Tuple

from .packets import (GAP, calibrations, closed_times, fault_times, heartbeats, late_times,
                      line_times)
from .records import Intervals
from .table import Row

# What a gap is put down to, and the rows of those that are not the bridge's.
_BRIDGE, _MACHINE, _SIMULATOR, _LINE, _USER = 'bridge', 'machine', 'simulator', 'line', 'user'
_APART = (
    (_MACHINE, 'gaps of 30 ms in which the whole machine stood still',
     'the process that only sleeps was late by what the gap is too long: nothing ran here'),
    (_SIMULATOR, 'gaps of 30 ms around a moment in which the simulator itself was late',
     'the simulated board was not woken in time by its own machine and may have read late what '
     'had come in time; its journal marks these moments'),
    (_LINE, 'gaps of 30 ms in which the line was late, not the bridge',
     'the bridge had handed the heartbeats over in time; the pseudo terminals that stand for the '
     'line passed them on late, by a kernel thread that competes with the busy processes'),
    (_USER, 'gaps of 30 ms of a bridge without real-time priority',
     'the user may not have it, so that a busy machine can make the bridge late: see "Let the '
     'bridge come first" in doc/troubleshooting.md'))


class Gap(NamedTuple):
    """From one heartbeat to the next, while the board took what came."""

    t: float
    seconds: float
    blame: str      # for a gap that is too long: who it is put down to; else the bridge


def check_heartbeat(journal: List[Dict], metronome: List[Dict], written: List[float],
                    end: float, excused: Intervals = Intervals(),
                    realtime: bool = True) -> List[Row]:
    """No gap while the port is open and the board takes what comes.

    Args:
        metronome: when a process that only sleeps, at the boards' priority, was woken late.
        written: when the bridge had handed heartbeats to its port, as serial_msg tells.
        excused: when the campaign had stopped the bridge.
        realtime: whether the bridge had real-time priority.
    """
    blind = excused + closed_times(journal, end) + fault_times(journal, ('stall',)) + Intervals(
        [(start, stop + 0.05) for start, stop in calibrations(journal, end)])
    gaps = _gaps(journal, metronome, written, blind, end, realtime)
    own = [gap.seconds for gap in gaps if gap.blame == _BRIDGE]
    handed_over = [after - before for before, after in zip(written, written[1:])
                   if after <= end and not blind.touches(before, after)]
    latest = max([one['late'] for one in metronome] or [0]) * 1e3
    rows = [
        Row('heartbeat', 'no gap of 30 ms while the port is open', len(own),
            [(gap.t, f'no heartbeat for {gap.seconds * 1e3:.1f} ms') for gap in gaps
             if gap.blame == _BRIDGE and gap.seconds >= GAP], _figures(own),
            note='beside it, a process that only sleeps 10 ms at a time was woken over 5 ms late '
                 f'{len(metronome)} times, by {latest:.0f} ms at most'),
        Row('heartbeat', 'likewise as the bridge handed them to its port', len(handed_over), [],
            _figures(handed_over), False)]
    for blame, says, why in _APART:
        found = [gap.seconds for gap in gaps if gap.blame == blame]
        worst = f'{max(found) * 1e3:.1f} ms' if found else ''
        rows.append(Row('heartbeat', says, len(found), [], worst, False, why if found else ''))
    return rows


def _gaps(journal: List[Dict], metronome: List[Dict], written: List[float], blind: Intervals,
          end: float, realtime: bool) -> List[Gap]:
    """All but those while the board could not take what came."""
    beats = heartbeats(journal)
    late, line = late_times(journal), line_times(beats, written)

    def blame(before: float, after: float) -> str:
        gap = after - before
        if gap < GAP:
            return _BRIDGE
        if gap - _stood_still(metronome, before, after) < GAP:
            return _MACHINE
        if late.touches(before, after):
            return _SIMULATOR
        if line.touches(before, after):
            return _LINE
        return _BRIDGE if realtime else _USER

    return [Gap(before, after - before, blame(before, after))
            for before, after in _pairs(journal, beats, end)
            if after <= end and not blind.touches(before, after)]


def _pairs(journal: List[Dict], beats: List[float], end: float) -> List[Tuple[float, float]]:
    """Neighbours, and the last heartbeat before a port went with that moment."""
    pairs = list(zip(beats, beats[1:]))
    for event in journal:
        if event['ev'] == 'port' and not event['open'] and event['t'] < end:
            at = bisect_right(beats, event['t']) - 1
            if at >= 0 and event['t'] - beats[at] >= GAP:
                pairs.append((beats[at], event['t'] - 1e-6))
    return pairs


def _stood_still(metronome: List[Dict], before: float, after: float) -> float:
    """For how much of this time the witness was not woken."""
    return sum(max(0.0, min(after, one['t'] + one['late']) - max(before, one['t']))
               for one in metronome)


def _figures(gaps: List[float]) -> str:
    if not gaps:
        return 'none'
    gaps = sorted(gaps)
    shown = ', '.join(f'{name} {gaps[min(int(len(gaps) * share), len(gaps) - 1)] * 1e3:.1f}'
                      for name, share in (('p50', .5), ('p99', .99), ('p99.99', .9999),
                                          ('max', 1)))
    return shown + ' ms'
