"""The invariants of the bus: what callers were told against what the board did. Pure functions."""
from bisect import bisect_right
from typing import Dict, List, NamedTuple, Tuple

from serial_communication.link.outcome import Verdict, verdict_of_failure
from serial_communication.boards.bus import wire as bus
from .records import Intervals
from .table import Row

NOT_SENT, TIMEOUT = 253, 254
PATIENCE = 1.0           # s over its timeout in which a call has to be answered
_JUDGED = ('lift', 'gimbal', 'raw', 'own')
_OWN_ECHO = 6            # bytes; the bridge's own ECHOs carry fewer
_OK_TO_PASS = 0.005      # s by which a journal's time may be off


class _Fate(NamedTuple):
    call: Dict
    executed: List[float]


def check_bus(calls: List[Dict], journal: List[Dict], blind_replies: List[float],
              timeouts: Dict[str, float], stopped: Intervals = Intervals(),
              no_master: Intervals = Intervals()) -> List[Row]:
    """All rows of the bus.

    Args:
        blind_replies: when damage made another valid reply of one.
        timeouts: of each kind of call, s.
        stopped: when the campaign had stopped the bridge.
        no_master: when there was no ROS master that knew the bridge, so that no caller who
            looks for a service finds it.
    """
    judged = [call for call in calls if call['kind'] in _JUDGED]
    executed = [event for event in journal if event['ev'] == 'executed' and _is_a_callers(event)]
    fates, orphans, blind = _attribute(judged, executed)
    blind_times = sorted(blind_replies + [event['t'] for event in blind])
    excused: List[Tuple[float, str]] = []

    def violations_of(found: List[Tuple[Dict, str]]) -> List[Tuple[float, str]]:
        """Those that no unseen damage explains."""
        out = []
        for call, what in found:
            end = call['t1'] if call['t1'] is not None else call['t0'] + 10
            at = bisect_right(blind_times, call['t0'] - _OK_TO_PASS)
            line = (call['t0'], f'{_name(call)} {_told(call)}, {what}')
            if at < len(blind_times) and blind_times[at] <= end + _OK_TO_PASS:
                excused.append(line)
            else:
                out.append(line)
        return out

    groups: Dict[str, List[_Fate]] = {'success': [], 'refused': [], 'timeout': [], 'lost': []}
    for fate in fates:
        groups[_group(fate.call)].append(fate)
    rows = [
        Row('bus', 'told success: executed exactly once', len(groups['success']), violations_of(
            [(f.call, f'executed {len(f.executed)} times') for f in groups['success']
             if len(f.executed) != 1])),
        Row('bus', 'told refused or not sent: not executed', len(groups['refused']), violations_of(
            [(f.call, f'executed at {_times(f.executed)}') for f in groups['refused']
             if f.executed])),
        Row('bus', 'told timeout: executed at most once', len(groups['timeout']), violations_of(
            [(f.call, f'executed at {_times(f.executed)}') for f in groups['timeout']
             if len(f.executed) > 1]),
            f"{sum(1 for f in groups['timeout'] if f.executed)} executed, "
            f"{sum(1 for f in groups['timeout'] if not f.executed)} not"),
        Row('bus', 'nothing executed twice', len(executed), violations_of(
            [(f.call, f'executed at {_times(f.executed)}') for f in fates
             if len(f.executed) > 1])),
        Row('bus', 'nothing executed that nobody asked for', len(executed),
            [(event['t'], event['text'][:80]) for event in orphans]),
        _wrong_replies(groups['success'], violations_of),
        answered(calls, timeouts, stopped, no_master)]
    count = len(blind) + len(blind_replies)
    rows.append(Row(
        'bus', 'damage that an XOR cannot see', count, [],
        f'{len({line[0] for line in excused})} calls told wrong by it', False,
        'a request or a reply that damage turned into another with a right checksum: one in 256 '
        'of those whose damage is not a single bit; nobody can tell it from a good one'
        if count else ''))
    return rows


def _is_a_callers(event: Dict) -> bool:
    """Not the bridge's own SYNCs, ECHOs and polls."""
    if event['cmd1'] == bus.ECHO:
        return len(event['data']) // 2 >= _OWN_ECHO
    return event['cmd1'] != bus.SYNC and not (
        event['cmd1'] == bus.FUNCTION and event['cmd2'] == bus.ENVIRONMENT)


def _attribute(calls: List[Dict], executed: List[Dict]):
    """Which call each execution was of: the latest with these bytes that had begun."""
    by_bytes: Dict[Tuple, List[Tuple[float, int]]] = {}
    for index, call in enumerate(calls):
        by_bytes.setdefault((call['cmd1'], call['cmd2'], call['data']), []).append(
            (call['t0'], index))
    for each in by_bytes.values():
        each.sort()
    fates = [_Fate(call, []) for call in calls]
    orphans, blind = [], []
    for event in executed:
        if event.get('genuine') is False:
            blind.append(event)
            continue
        begun = by_bytes.get((event['cmd1'], event['cmd2'], event['data']), [])
        at = bisect_right(begun, (event['t'] + _OK_TO_PASS, len(calls))) - 1
        if at < 0:
            orphans.append(event)
        else:
            fates[begun[at][1]].executed.append(event['t'])
    return fates, orphans, blind


def _group(call: Dict) -> str:
    if call['t1'] is None or 'exception' in call:
        return 'lost'
    if call['success']:
        return 'success'
    return 'refused' if verdict_of_failure(call['status']) is Verdict.REFUSED else 'timeout'


def _wrong_replies(succeeded: List[_Fate], violations_of) -> Row:
    raw = [fate.call for fate in succeeded if fate.call['kind'] == 'raw']
    return Row('bus', 'no reply to the wrong caller (raw: its own unique data)', len(raw),
               violations_of([(call, f"with the reply {call['reply'][:40]}") for call in raw
                              if call['reply'] != call['data']]))


def answered(calls: List[Dict], timeouts: Dict[str, float], stopped: Intervals = Intervals(),
             no_master: Intervals = Intervals()) -> Row:
    """Every caller was answered, whatever happened; `stopped` and `no_master` as above."""
    violations, worst, tries = [], 0.0, 0
    for call in calls:
        if call['kind'] not in timeouts:
            continue
        tries += 1
        if call['t1'] is None:
            violations.append((call['t0'], f'{_name(call)} was never answered'))
            continue
        if 'exception' in call and no_master.touches(call['t0'], call['t1']):
            continue
        over = (call['t1'] - call['t0'] - timeouts[call['kind']]
                - stopped.seconds_within(call['t0'], call['t1']))
        worst = max(worst, over)
        if 'exception' in call:
            violations.append((call['t0'], f"{_name(call)}: {call['exception'][:100]}"))
        elif over > PATIENCE:
            violations.append((call['t0'], f'{_name(call)} answered {over:.2f} s after its '
                               f'timeout ({call["message"][:80]})'))
    return Row('bus', 'every call answered within its timeout + 1 s', tries, violations,
               f'{worst:.2f} s after its timeout')


def outcomes(calls: List[Dict]) -> str:
    """How many calls were told what, in words."""
    counts: Dict[str, int] = {}
    for call in calls:
        if call['kind'] in _JUDGED:
            group = _group(call)
            if group == 'refused' and call['status'] == NOT_SENT:
                group = 'not sent'
            counts[group] = counts.get(group, 0) + 1
    return ', '.join(f'{counts[key]} {key}' for key in (
        'success', 'refused', 'not sent', 'timeout', 'lost') if key in counts)


def _name(call: Dict) -> str:
    return f"{call['kind']} {call.get('data', '')[:24]}"


def _told(call: Dict) -> str:
    if call['t1'] is None:
        return 'never answered'
    if 'exception' in call:
        return call['exception'][:80]
    return (f"told {_group(call)} (status {call.get('status', 0)}) "
            f"after {call['t1'] - call['t0']:.3f} s")


def _times(times: List[float]) -> str:
    return ', '.join(f'{t:.3f}' for t in times)
