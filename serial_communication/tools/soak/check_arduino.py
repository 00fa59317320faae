"""The heartbeat and the motor, as the model car saw them. Pure functions over records (see
records.py)."""
from bisect import bisect_left, bisect_right
from typing import Dict, Iterable, List, NamedTuple, Optional, Tuple

from ...protocols import arduino
from .records import Intervals
from .table import Row

GAP = 0.030              # s without a heartbeat after which the board stops its motor
LATE_ZERO = 0.050        # s that SPEED 0 may come later than speed_timeout
_CROSSING = 0.010        # s that a byte may take from one end of the line to the other
_KEPT = 1.0              # s; a command that reaches the board later than this was kept
_CALIBRATION_CALL = 5.0  # s after a call in which the board's calibration is that call's


class Packet(NamedTuple):
    """A packet that reached the board's end of the line, whatever the board made of it."""

    t: float
    type: int
    data: bytes
    taken: bool = True       # the board has read it, at that time


def packets_of(journal: List[Dict]) -> Tuple[List[Packet], List[Packet]]:
    """All that the bridge sent, as the port gave it; and what damage in the board made."""
    came, made = [], []
    damaged = {event['t']: event for event in journal if event['ev'] == 'rx-fault'}
    rest = b''      # what damage has left of a packet without its end: the next one joins it
    for event in journal:
        kind, t = event['ev'], event['t']
        if kind == 'rx-fault':
            came += _decoded(t, event['came'])
            rest = (rest + bytes.fromhex(event['became'])).rpartition(b'\0')[2]
        elif kind == 'rx-lost':
            came += _decoded(t, event['data'], False)
        elif kind == 'calibrate' and event.get('kept'):
            came += _decoded(t, event['kept'], False)
        elif kind == 'rx' and t in damaged:
            packet = _packet(event)
            if packet and packet not in _decoded(t, damaged[t]['came']):
                made.append(packet)
        elif kind == 'rx':
            packet = _packet(event)
            raw = arduino.encode_raw(packet.type, packet.data) if packet else bytes.fromhex(
                event['raw'])
            if rest and raw.startswith(rest):
                came += _decoded(t, raw[len(rest):].hex())
                made += [packet] if packet else []
            else:
                came += [packet] if packet else _behind_damage(t, raw)
            rest = b''
    return came, made


def _packet(event: Dict) -> Optional[Packet]:
    """Of an `rx`; None where the board made nothing of it."""
    if 'type' not in event:
        return None
    return Packet(event['t'], event['type'], bytes.fromhex(event['data']))


def _behind_damage(t: float, raw: bytes) -> List[Packet]:
    """The packet at the end of a bad one: its start is what damage has left of another."""
    for start in range(1, len(raw) - 2):
        found = _decoded(t, raw[start:].hex(), False)
        if found:
            return found
    return []


def _decoded(t: float, data: str, taken: bool = True) -> List[Packet]:
    return [Packet(t, frame.type, frame.data, taken)
            for frame in arduino.BoardDecoder().feed(bytes.fromhex(data)) if not frame.cause]


def closed_times(journal: List[Dict], end: float) -> Intervals:
    """When the board's end of its port was closed."""
    pairs, since = [], 0.0
    for event in journal:
        if event['ev'] == 'port':
            if event['open']:
                if since is not None:
                    pairs.append((since, event['t']))
                since = None
            else:
                since = event['t']
    if since is not None:
        pairs.append((since, max(end, since)))
    return Intervals(pairs)


def fault_times(journal: List[Dict], kinds: Iterable[str], after: float = 0.05) -> Intervals:
    """When the board had such a fault, and a little longer."""
    return Intervals([(event['t'], event['t'] + event['seconds'] + after) for event in journal
                      if event['ev'] == 'fault' and event['kind'] in kinds])


def calibrations(journal: List[Dict], end: float) -> List[Tuple[float, float]]:
    """When the board calibrated."""
    pairs: List[Tuple[float, float]] = []
    since = None
    for event in journal:
        if event['ev'] == 'calibrate' and event['on']:
            since = event['t']
        elif since is not None and (event['ev'] == 'boot' or event['ev'] == 'calibrate'):
            pairs.append((since, event['t']))
            since = None
    if since is not None:
        pairs.append((since, max(end, since)))
    return pairs


def late_times(journal: List[Dict]) -> Intervals:
    """When the simulated board was not woken by its machine."""
    return Intervals([(event['t'] - event['by'] - 0.001, event['t'] + 0.001)
                      for event in journal if event['ev'] == 'late'])


def line_times(beats: List[float], written: List[float]) -> Intervals:
    """When the line itself was late: a heartbeat had been written in time and came much later.

    A pseudo terminal passes bytes on in a kernel thread of ordinary priority, which competes
    with whatever else this machine runs. A serial line does not.

    Args:
        beats: when heartbeats came; `written`: when the bridge had handed them to its port.
    """
    pairs = []
    for before, after in zip(beats, beats[1:]):
        if after - before < 2 * _CROSSING:
            continue
        at = bisect_right(written, before + 0.003)
        # The one written before this gap may be the one that ended it, too.
        if at and at < len(written) and written[at] - written[at - 1] < GAP and \
                written[at] - before < GAP and after - written[at] > _CROSSING:
            pairs.append((written[at], after))
    return Intervals(pairs)


def check_heartbeat(journal: List[Dict], metronome: List[Dict], written: List[float],
                    end: float) -> List[Row]:
    """No gap while the port is open and the board takes what comes.

    Args:
        metronome: when a process that only sleeps, at the boards' priority, was woken late.
        written: when the bridge had handed heartbeats to its port, as serial_msg tells.
    """
    beats = sorted({packet.t for packet in packets_of(journal)[0] if packet.type == 11})
    blind = closed_times(journal, end) + fault_times(journal, ('stall',)) + Intervals(
        [(start, stop + 0.05) for start, stop in calibrations(journal, end)])
    late, line = late_times(journal), line_times(beats, written)
    gaps, violations = [], []
    apart: Dict[str, List[float]] = {'machine': [], 'simulator': [], 'line': []}
    ends = [event['t'] for event in journal if event['ev'] == 'port' and not event['open']]
    pairs = list(zip(beats, beats[1:]))
    for closing in ends:        # the last beat before a port went
        at = bisect_right(beats, closing) - 1
        if closing < end and at >= 0 and closing - beats[at] >= GAP:
            pairs.append((beats[at], closing - 1e-6))
    for before, after in pairs:
        if after > end or blind.touches(before, after):
            continue
        gap = after - before
        if gap >= GAP and gap - _stood_still(metronome, before, after) < GAP:
            apart['machine'].append(gap)
        elif gap >= GAP and late.touches(before, after):
            apart['simulator'].append(gap)
        elif gap >= GAP and line.touches(before, after):
            apart['line'].append(gap)
        else:
            gaps.append(gap)
            if gap >= GAP:
                violations.append((before, 'no heartbeat for %.1f ms' % (gap * 1e3)))
    own = [after - before for before, after in zip(written, written[1:])
           if after <= end and not blind.touches(before, after)]
    return [
        Row('heartbeat', 'no gap of 30 ms while the port is open', len(gaps), violations,
            _figures(gaps),
            note='beside it, a process that only sleeps 10 ms at a time was woken over 5 ms late '
            '%d times, by %.0f ms at most' % (
                len(metronome), max([one['late'] for one in metronome] or [0]) * 1e3)),
        Row('heartbeat', 'likewise as the bridge handed them to its port', len(own), [],
            _figures(own), False),
        Row('heartbeat', 'gaps of 30 ms in which the whole machine stood still',
            len(apart['machine']), [], _longest(apart['machine']), False,
            'the process that only sleeps was late by what the gap is too long: nothing ran here'
            if apart['machine'] else ''),
        Row('heartbeat', 'gaps of 30 ms around a moment in which the simulator itself was late',
            len(apart['simulator']), [], _longest(apart['simulator']), False,
            'the simulated board was not woken in time by its own machine and may have read late '
            'what had come in time; its journal marks these moments'
            if apart['simulator'] else ''),
        Row('heartbeat', 'gaps of 30 ms in which the line was late, not the bridge',
            len(apart['line']), [], _longest(apart['line']), False,
            'the bridge had handed the heartbeats over in time; the pseudo terminals that stand '
            'for the line passed them on late, by a kernel thread that competes with the busy '
            'processes' if apart['line'] else '')]


def _stood_still(metronome: List[Dict], before: float, after: float) -> float:
    """For how much of this time the witness was not woken."""
    return sum(max(0.0, min(after, one['t'] + one['late']) - max(before, one['t']))
               for one in metronome)


def _figures(gaps: List[float]) -> str:
    gaps = sorted(gaps)
    return ', '.join('%s %.1f' % (name, gaps[min(int(len(gaps) * share), len(gaps) - 1)] * 1e3)
                     for name, share in (('p50', .5), ('p99', .99), ('p99.99', .9999),
                                         ('max', 1))) + ' ms' if gaps else 'none'


def _longest(gaps: List[float]) -> str:
    return '%.1f ms' % (max(gaps) * 1e3) if gaps else ''


def check_motor(journal: List[Dict], commands: List[Dict], unplugged: List[float],
                bridge_calibrations: Intervals, written: List[float], stood_still: Intervals,
                speed_timeout: float, end: float) -> List[Row]:
    """What reached the motor was commanded, just now, and ends in time.

    Args:
        bridge_calibrations: when the bridge said that it took no commands.
        written: when the bridge had handed heartbeats to its port.
        stood_still: when the whole machine did.
    """
    came, made = packets_of(journal)
    speeds = sorted((packet for packet in came if packet.type == 4 and packet.t <= end),
                    key=lambda packet: packet.t)
    published: Dict[int, List[float]] = {}
    for entry in commands:
        if entry['topic'] == 'speed':
            published.setdefault(_saturated(entry['value']), []).append(entry['t'])
    zeros = published.get(0, [])
    calls = [entry['t0'] for entry in commands if entry['topic'] == 'calibrate'
             and not entry['error']]
    deaf = Intervals([pair for pair in calibrations(journal, end)
                      if any(pair[0] - _CALIBRATION_CALL <= call <= pair[0] for call in calls)])
    began = {start for start, _end in deaf.pairs}
    stalled = fault_times(journal, ('stall', 'reset'), 0.2)
    old, calibrating, uncommanded, zero_rows = [], [], [], []
    tries_old = tries_zero = 0
    worst_zero = oldest = 0.0
    used = set()
    blind = closed_times(journal, end) + stalled + stood_still + Intervals(
        calibrations(journal, end)) + late_times(journal) + line_times(
            sorted({packet.t for packet in came if packet.type == 11}), written)
    for index, packet in enumerate(speeds):
        value = int.from_bytes(packet.data, 'little', signed=True)
        if value:
            times = published.get(value, [])
            at = bisect_right(times, packet.t) - 1
            if at < 0:
                uncommanded.append((packet.t, 'SPEED %d, which nobody commanded' % value))
                continue
            tries_old += 1
            commanded = times[at]
            age = packet.t - commanded
            if abs(value) < arduino.SPEED_LIMIT:
                if (value, commanded) in used:
                    uncommanded.append((packet.t, 'SPEED %d twice, commanded once' % value))
                used.add((value, commanded))
            if not stalled.holds(packet.t):
                oldest = max(oldest, age)
                if age > _KEPT:
                    old.append((packet.t, 'SPEED %d, commanded %.2f s before' % (value, age)))
            cut = bisect_left(unplugged, commanded)
            if cut < len(unplugged) and unplugged[cut] < packet.t:
                old.append((packet.t, 'SPEED %d, commanded at %.3f; the port went at %.3f'
                            % (value, commanded, unplugged[cut])))
            # What the board took in the same read as the call came before it.
            if deaf.holds(packet.t) and not (packet.taken and packet.t in began):
                calibrating.append((packet.t, 'SPEED %d reached the board while it calibrated'
                                    % value))
            elif bridge_calibrations.holds(commanded):
                calibrating.append((packet.t, 'SPEED %d, commanded at %.3f, during a calibration'
                                    % (value, commanded)))
        following = speeds[index + 1] if index + 1 < len(speeds) else None
        if not value:
            continue
        until = following.t if following else end
        if blind.touches(packet.t, min(until, packet.t + speed_timeout + LATE_ZERO)):
            continue
        tries_zero += 1
        gap = until - packet.t
        if gap > speed_timeout + LATE_ZERO:
            zero_rows.append((packet.t, 'SPEED %d, then nothing for %.0f ms' % (value, gap * 1e3)))
        if following and not int.from_bytes(following.data, 'little', signed=True):
            at = bisect_right(zeros, following.t) - 1
            if at < 0 or zeros[at] < packet.t - 0.1:     # nobody commanded it
                worst_zero = max(worst_zero, gap)
                if gap < speed_timeout - 0.05 and not bisect_right(
                        calls, following.t) - bisect_right(calls, packet.t - 0.1):
                    uncommanded.append((following.t, 'SPEED 0 after %.0f ms, which nobody '
                                        'commanded' % (gap * 1e3)))
    ran_on = _ran_on(journal, speeds, deaf + stalled)
    return [
        Row('arduino', 'nothing for the motor that was commanded before a reconnect', tries_old,
            old, 'oldest command %.0f ms' % (oldest * 1e3)),
        Row('arduino', 'nothing for the motor that was commanded during a calibration',
            len(deaf.pairs), calibrating, '%.1f s of calibration' % deaf.seconds()),
        Row('arduino', 'SPEED 0 within speed_timeout + 50 ms of the last command', tries_zero,
            zero_rows, '%.0f ms' % (worst_zero * 1e3)),
        Row('arduino', 'no speed that was not commanded, none twice', len(speeds), uncommanded),
        Row('arduino', 'SPEED 0 that damage on the way took: the motor ran on', len(ran_on), [],
            'for %.1f s' % max(ran_on) if ran_on else '', False,
            'the bridge sent it in time, the line lost it; the heartbeat keeps the motor running '
            'until something else stops it' if ran_on else ''),
        Row('arduino', 'packets that damage on the way to the board made', len(made), [], '', False,
            'the link has no checksum: the board takes damaged bytes for a command if they '
            'decode' if made else '')]


def _ran_on(journal: List[Dict], speeds: List[Packet], but: Intervals) -> List[float]:
    """How long the motor ran on after each SPEED 0 that reached the port and not the board."""
    states = [(event['t'], event['on']) for event in journal if event['ev'] == 'motor']
    times = [t for t, _on in states]
    found = []
    for packet in speeds:
        at = bisect_right(times, packet.t + 0.05) - 1
        if packet.data == bytes(2) and at >= 0 and states[at][1] and times[at] < packet.t and \
                not but.holds(packet.t):
            until = times[at + 1] if at + 1 < len(times) else packet.t
            found.append(until - packet.t)
    return found


def _saturated(value: int) -> int:
    return min(max(value, -arduino.SPEED_LIMIT), arduino.SPEED_LIMIT)
