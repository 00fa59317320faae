"""The motor, as the model car saw it: what came for it was commanded, just now, and it stops.

Pure functions over records (see records.py): one list is prepared, and each row is one function
over it.
"""
from bisect import bisect_left, bisect_right
from typing import Dict, List, NamedTuple, Optional, Tuple

from .packets import (HEARTBEAT, SPEED, Packet, calibrations, closed_times, fault_times, late_times,
                      line_times, packets_of)
from .records import Intervals
from .table import Row

LATE_ZERO = 0.050        # s that SPEED 0 may come later than speed_timeout
STANDS = 0.3             # s over speed_timeout after a command in which the motor has to stand
_REPEATED = 1.0          # s for which the bridge repeats the SPEED 0 of a stop
_COMES_BACK = 1.5        # s from a port's return until the bridge has opened it
_SLACK = 0.15            # s by which the bridge may be late with all of that
_LIMIT = 1000            # of SPEED, either way
KEPT = 1.0               # s; a command that reaches the board later than this was kept
_ORDER = 0.1             # s by which a command and a packet may be seen in another order
_CALIBRATION_CALL = 5.0  # s after a call in which the board's calibration is that call's


class Speed(NamedTuple):
    """A SPEED that reached the board's end of the line."""

    t: float
    value: int
    commanded: Optional[float]      # when somebody published it last before; None: nobody did
    taken: bool                     # the board has read it, at that time
    until: float                    # when the next one came, or the end
    next_value: Optional[int]       # of that one; None: there is none


class Drive(NamedTuple):
    """All that the rows are about."""

    speeds: List[Speed]
    made: List[Packet]              # by damage on the way to the board
    zeros: List[float]              # when SPEED 0 was published
    calls: List[float]              # for a calibration
    absent: Intervals               # from the port's going, at the latest, to its return
    deaf: Intervals                 # while the board calibrates for one of these calls
    bridge_calibrates: Intervals    # while the bridge says that it takes no commands
    stalled: Intervals              # while the board reads nothing
    closed: Intervals               # while the board's end of its port was
    doubtful: Intervals             # while the campaign kept the bridge, or its output, from work
    blind: Intervals                # while nobody can tell when a packet came
    motor: List[Tuple[float, bool]]  # what it was told, and when: on (again), or off
    began: List[float]              # when the very first packet came, if any did
    speed_timeout: float


def prepare(journal: List[Dict], commands: List[Dict], absent: Intervals,
            bridge_calibrates: Intervals, written: List[float], stood_still: Intervals,
            doubtful: Intervals, speed_timeout: float, end: float) -> Drive:
    """From the records.

    Args:
        absent: when the port was; what comes before its return came by the connection of before.
        written: when the bridge had handed heartbeats to its port.
        stood_still: when the whole machine did.
        doubtful: when the campaign had stopped the bridge, or the line to the board.
    """
    came, made = packets_of(journal)
    calls = [entry['t0'] for entry in commands if entry['topic'] == 'calibrate'
             and not entry['error']]
    stalled = fault_times(journal, ('stall', 'reset'), 0.2)
    beats = sorted({packet.t for packet in came if packet.type == HEARTBEAT})
    return Drive(
        _speeds(came, commands, end), made,
        [entry['t'] for entry in commands if entry['topic'] == 'speed' and not entry['value']],
        calls, absent,
        Intervals([pair for pair in calibrations(journal, end)
                   if any(pair[0] - _CALIBRATION_CALL <= call <= pair[0] for call in calls)]),
        bridge_calibrates, stalled, closed_times(journal, end), doubtful + stood_still,
        closed_times(journal, end) + stalled + stood_still
        # A line that thaws passes on SPEED 0 and more before the bridge, which had just dropped
        # what waited, can know of it: it says SPEED 0 once more.
        + doubtful.longer(_ORDER)
        + Intervals(calibrations(journal, end)) + late_times(journal) + line_times(beats, written),
        [(event['t'], event['on']) for event in journal if event['ev'] == 'motor'
         and event['t'] < end] + [(end, False)],
        sorted(packet.t for packet in came)[:1], speed_timeout)


def _speeds(came: List[Packet], commands: List[Dict], end: float) -> List[Speed]:
    published: Dict[int, List[float]] = {}
    for entry in commands:
        if entry['topic'] == 'speed':
            value = min(max(entry['value'], -_LIMIT), _LIMIT)
            published.setdefault(value, []).append(entry['t'])
    packets = sorted((packet for packet in came if packet.type == SPEED and packet.t <= end),
                     key=lambda packet: packet.t)
    values = [int.from_bytes(packet.data, 'little', signed=True) for packet in packets]
    found = []
    for index, (packet, value) in enumerate(zip(packets, values)):
        times = published.get(value, [])
        at = bisect_right(times, packet.t) - 1
        last = index + 1 == len(packets)
        found.append(Speed(packet.t, value, times[at] if at >= 0 else None, packet.taken,
                           end if last else packets[index + 1].t,
                           None if last else values[index + 1]))
    return found


def check_motor(drive: Drive) -> List[Row]:
    """All rows."""
    return [_nothing_old(drive), _nothing_while_calibrating(drive), _zero_in_time(drive),
            _all_commanded(drive), _zeros_by_the_rules(drive), *_stands(drive), _made(drive)]


def _nothing_old(drive: Drive) -> Row:
    violations, oldest, tries = [], 0.0, 0
    for speed in drive.speeds:
        if not speed.value or speed.commanded is None:
            continue
        tries += 1
        age = speed.t - speed.commanded
        if not drive.stalled.holds(speed.t) and not _in_the_cable(speed, drive.doubtful):
            oldest = max(oldest, age)
            if age > KEPT:
                violations.append((speed.t, f'SPEED {speed.value}, commanded {age:.2f} s before'))
        absence = drive.absent.first_within(speed.commanded, speed.t)
        if absence:
            violations.append((speed.t, f'SPEED {speed.value}, commanded at {speed.commanded:.3f}'
                                        f'; the port went at {absence[0]:.3f}'))
    return Row('arduino', 'nothing for the motor that was commanded before a reconnect', tries,
               violations, f'oldest command {oldest * 1e3:.0f} ms')


def _in_the_cable(speed: Speed, frozen: Intervals) -> bool:
    """Whether it was on its way as the line froze, and came as it thawed: nobody can drop it."""
    return any(start - _ORDER <= speed.commanded <= start + _ORDER and over <= speed.t
               for start, over in frozen.pairs)


def _nothing_while_calibrating(drive: Drive) -> Row:
    began = {start for start, _end in drive.deaf.pairs}
    violations = []
    for speed in drive.speeds:
        if not speed.value or speed.commanded is None:
            continue
        # What the board took in the same read as the call came before it.
        if drive.deaf.holds(speed.t) and not (speed.taken and speed.t in began):
            violations.append((speed.t, f'SPEED {speed.value} reached the board while it '
                                        'calibrated'))
        elif drive.bridge_calibrates.holds(speed.commanded):
            violations.append((speed.t, f'SPEED {speed.value}, commanded at '
                                        f'{speed.commanded:.3f}, during a calibration'))
    return Row('arduino', 'nothing for the motor that was commanded during a calibration',
               len(drive.deaf.pairs), violations, f'{drive.deaf.seconds():.1f} s of calibration')


def _judged(drive: Drive) -> List[Speed]:
    """Those of which it is known when the next one came."""
    patience = drive.speed_timeout + LATE_ZERO
    return [speed for speed in drive.speeds if speed.value and speed.commanded is not None
            and not drive.blind.touches(speed.t, min(speed.until, speed.t + patience))]


def _commanded_zero(drive: Drive, speed: Speed) -> bool:
    """Whether the SPEED 0 that follows was commanded."""
    at = bisect_right(drive.zeros, speed.until) - 1
    return at >= 0 and drive.zeros[at] >= speed.t - _ORDER


def _zero_in_time(drive: Drive) -> Row:
    violations, worst = [], 0.0
    judged = _judged(drive)
    for speed in judged:
        gap = speed.until - speed.t
        if gap > drive.speed_timeout + LATE_ZERO:
            violations.append((speed.t, f'SPEED {speed.value}, then nothing for '
                                        f'{gap * 1e3:.0f} ms'))
        if speed.next_value == 0 and not _commanded_zero(drive, speed):
            worst = max(worst, gap)
    return Row('arduino', 'SPEED 0 within speed_timeout + 50 ms of the last command', len(judged),
               violations, f'{worst * 1e3:.0f} ms')


def _all_commanded(drive: Drive) -> Row:
    violations: List[Tuple[float, str]] = []
    used = set()
    for speed in drive.speeds:
        if not speed.value:
            continue
        if speed.commanded is None:
            violations.append((speed.t, f'SPEED {speed.value}, which nobody commanded'))
        elif abs(speed.value) < _LIMIT:     # what was saturated occurs twice
            if (speed.value, speed.commanded) in used:
                violations.append((speed.t, f'SPEED {speed.value} twice, commanded once'))
            used.add((speed.value, speed.commanded))
    for speed in _judged(drive):
        gap = speed.until - speed.t
        called = bisect_right(drive.calls, speed.until) > bisect_right(drive.calls,
                                                                       speed.t - _ORDER)
        if speed.next_value == 0 and gap < drive.speed_timeout - LATE_ZERO and not called \
                and not _commanded_zero(drive, speed):
            violations.append((speed.until, f'SPEED 0 after {gap * 1e3:.0f} ms, which nobody '
                                            'commanded'))
    return Row('arduino', 'no speed that was not commanded, none twice', len(drive.speeds),
               sorted(violations))


def _zeros_by_the_rules(drive: Drive) -> Row:
    """Each SPEED 0 was commanded, or is one that the bridge owes: at an opening of the port, at
    a timeout, before a calibration, after a standstill or dropped output, and repeated for 1 s."""
    stop = _REPEATED + _SLACK
    owed = [(start, over + _COMES_BACK + stop) for start, over in drive.closed.pairs]
    owed += [(start, over + stop) for start, over in (drive.doubtful + drive.stalled).pairs]
    owed += [(t - _ORDER, t + stop) for t in drive.zeros + drive.calls]
    owed += [(speed.t, speed.t + drive.speed_timeout + stop)
             for speed in drive.speeds if speed.value]
    # Those that were on their way as the board began to calibrate it reads at the end of that.
    owed += [(over, over + _SLACK) for _start, over in drive.deaf.pairs]
    # With the first packet of all the bridge has opened its port, whenever it was started.
    owed += [(t, t + stop) for t in drive.began]
    allowed = Intervals(owed)
    zeros = [speed.t for speed in drive.speeds if not speed.value]
    return Row('arduino', 'SPEED 0 commanded, or where a rule has it, and never else', len(zeros),
               [(t, 'SPEED 0, which nobody commanded and no rule has') for t in zeros
                if not allowed.holds(t)])


def _stands(drive: Drive) -> List[Row]:
    """The motor, as it turned: whatever the line took, it stops soon after the last command."""
    says = 'the motor stands within speed_timeout + 0.3 s of the last command'
    commanded = [(speed.t, speed.commanded) for speed in drive.speeds
                 if speed.value and speed.commanded is not None]
    arrived = [t for t, _commanded in commanded]
    invented = {packet.t for packet in drive.made if packet.type == SPEED}
    violations, worst, apart = [], 0.0, 0
    for (began, on), (until, _on) in zip(drive.motor, drive.motor[1:]):
        if not on or until == began:    # one read of the board's: the motor has not turned
            continue
        if began in invented:
            apart += 1
            continue
        # What the board makes of SPEED at `until` itself is the next stretch.
        at = bisect_left(arrived, until) - 1
        last = commanded[at][1] if at >= 0 else began
        if drive.stalled.holds(began):      # a board that read nothing takes it only now
            last = max(last, began)
        worst = max(worst, until - last)
        if until - last > drive.speed_timeout + STANDS:
            violations.append((until, f'the motor ran until {until - last:.2f} s after the last '
                                      'command'))
    return [Row('arduino', says, sum(on for _t, on in drive.motor), violations,
                f'{worst * 1e3:.0f} ms'),
            Row('arduino', 'motor that turned by a SPEED which damage on the way made', apart, [],
                '', False, 'the link has no checksum: the bridge does not know of it, and '
                'stops it only by its next SPEED' if apart else '')]


def _made(drive: Drive) -> Row:
    return Row('arduino', 'packets that damage on the way to the board made', len(drive.made), [],
               '', False,
               'the link has no checksum: the board takes damaged bytes for a command if they '
               'decode' if drive.made else '')
