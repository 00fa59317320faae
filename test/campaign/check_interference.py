"""What the campaign does to the bridge itself and to what it stands on: it is stopped, its line
freezes, nobody reads what it says, its network and its master go. Pure functions over records."""
from bisect import bisect_left, bisect_right
from typing import Any, Dict, FrozenSet, List, NamedTuple, Optional, Tuple

from .check_motor import Speed
from .packets import CROSSING, HEARTBEAT, SPEED, STEERING, Packet
from .records import Intervals
from .table import Row

QUIET = 8.0              # s without data while a port stays, more than faults of a board explain
_BEAT = 0.010            # s from one heartbeat to the next
_AROUND = 0.002          # s by which the records may be off
_HANDED = 0.05           # s from a command to its write, on a busy computer
NETWORK_AGE = 1.5        # s; what a frozen network lets through late is no older
NETWORK_RETURN = 3.0     # s from a network's return until heartbeats reach the board
MASTER_RETURN = 10.0     # s from a new master's start until it knows the bridge
_SPEED_0 = (SPEED, b'\0\0')


class Connection(NamedTuple):
    """A connection of the bridge's, by the bridge's stamp of its first frame."""

    t: float
    link: str
    name: str


def check_standstill(stopped: Intervals, came: List[Packet], speeds: List[Speed],
                     steering: List[Tuple[float, int]], unclear: Intervals) -> List[Row]:
    """SIGSTOP and SIGCONT.

    One packet may have been decided on as the bridge was stopped: it leaves as the bridge goes on,
    before anything can be looked at, and SPEED 0 is the next.

    Args:
        stopped: when the bridge was.
        came: what reached the board, in order.
        steering: the commands.
        unclear: when the board could not take what came, or its port was closed.
    """
    first: List[Tuple[float, str]] = []
    old: List[Tuple[float, str]] = []
    tries = 0
    times = [packet.t for packet in came]
    beats = [packet.t for packet in came if packet.type == HEARTBEAT]
    for start, over in stopped.pairs:
        if unclear.touches(start - 0.1, over + 0.1):
            continue
        tries += 1
        at = bisect_right(times, over)
        begun = over
        if not _is_speed_0(came[at:at + 1]) and came[at:] and _was_decided_on(
                came[at], start, beats, speeds, steering):
            begun = came[at].t
            at += 1
        if not _is_speed_0(came[at:at + 1]):
            first.append((over, f'the first packet afterwards is {came[at:at + 1] or "none"}'))
        old += [(speed.t, f'SPEED {speed.value}, commanded {speed.t - speed.commanded:.2f} s '
                          'before') for speed in speeds
                if speed.value and speed.commanded is not None
                and speed.t > begun and speed.commanded <= over]
    return [Row('standstill', 'SPEED 0 is the first packet after SIGSTOP and SIGCONT', tries,
                first),
            Row('standstill', 'no command of before or meanwhile drives the motor', tries, old)]


def _was_decided_on(packet: Packet, start: float, beats: List[float], speeds: List[Speed],
                    steering: List[Tuple[float, int]]) -> bool:
    """Whether it is a heartbeat that was due just as the bridge was stopped, or a command that
    came just before."""
    if packet.type == HEARTBEAT:
        before = bisect_right(beats, start)
        return before > 0 and abs(start - beats[before - 1] - _BEAT) < _AROUND
    told: List[Optional[float]] = []
    if packet.type == SPEED:
        told = [speed.commanded for speed in speeds if speed.t == packet.t]
    elif packet.type == STEERING:
        value = int.from_bytes(packet.data, 'little')
        told = [t for t, commanded in steering if commanded == value]
    return any(t is not None and start - _HANDED < t <= start for t in told)


def check_frozen_line(frozen: Intervals, filled: List[float], written: List[Packet],
                      came: List[Packet], unclear: Intervals) -> Row:
    """A board that reads nothing, until the bridge drops what waits, and then reads again.

    A pseudo terminal hands up to 4095 bytes to its other end at once, where no flush reaches
    them; a UART does not. So what the bridge had written before the campaign filled that place
    comes before SPEED 0, and nothing else may.

    Args:
        filled: when the campaign had.
        written: what the bridge had handed to its port, and when, in order.
    """
    violations, tries = [], 0
    for start, over in frozen.pairs:
        if unclear.touches(start - 0.1, over + 0.1):
            continue
        tries += 1
        at = bisect_right([packet.t for packet in came], over)
        full = next((t for t in filled if start <= t <= over), start)
        heads = came[at:at + _under_way(written, full, came[:at]) + 1]
        if not any(_is_speed_0([packet]) for packet in heads):
            violations.append((over, f'the first packets afterwards are {heads or "none"}'))
    return Row('arduino', 'dropped output, then the board reads again: SPEED 0 comes first', tries,
               violations)


def _under_way(written: List[Packet], full: float, came: List[Packet]) -> int:
    """How many packets were written by the time `full` and had not come.

    The latest steering that came tells which of all packets it was: no value recurs soon.
    """
    until = bisect_right([packet.t for packet in written], full + CROSSING)
    for behind, packet in enumerate(reversed(came)):
        if packet.type != STEERING:
            continue
        for index in range(until - 1, -1, -1):
            if (written[index].type, written[index].data) == (STEERING, packet.data):
                return max(0, until - index - 1 - behind)
    return 0


def _is_speed_0(packets: List[Packet]) -> bool:
    return bool(packets) and (packets[0].type, packets[0].data) == _SPEED_0


def opened_anew(absent: Dict[str, Intervals], opened: List[Connection]) -> List[Connection]:
    """The connections, but each link's first, that no absence of the port explains."""
    found = []
    latest: Dict[str, Connection] = {}
    for one in opened:
        before = latest.get(one.link)
        latest[one.link] = one
        if before and not absent[one.link].touches(before.t, one.t):
            found.append(one)
    return found


def check_unread(unread: Intervals, lines: int, data: Dict[str, List[float]],
                 excused: Dict[str, Intervals], anew: List[Connection]) -> Row:
    """The reader of stdout and stderr has gone; the links go on.

    Args:
        lines: that the bridge had to say meanwhile.
        data: by link, when frames came in; `excused`: when none could.
        anew: connections that had no reason.
    """
    violations, worst = [(one.t, f'the port of the {one.link} link was opened anew')
                         for one in anew if unread.holds(one.t)], 0.0
    for start, over in unread.pairs:
        for link, times in data.items():
            within = [start] + [t for t in times if start < t < over] + [over]
            for before, after in zip(within, within[1:]):
                gap = after - before - excused[link].seconds_within(before, after)
                worst = max(worst, gap)
                if gap > QUIET:
                    violations.append((before, f'no data of the {link} link for {gap:.1f} s'))
    return Row('node', 'links go on while nobody reads what it says (a broken pipe)', lines,
               sorted(violations), f'{worst:.1f} s without data' if lines else '')


def check_network(events: List[Dict], came: List[Packet], speeds: List[Speed],
                  end: float) -> List[Row]:
    """A board behind a network that freezes, and that forgets a connection.

    Args:
        events: of the link `network`.
    """
    old, oldest, tries = [], 0.0, 0
    for speed in speeds:
        if speed.value and speed.commanded is not None:
            tries += 1
            age = speed.t - speed.commanded
            oldest = max(oldest, age)
            if age > NETWORK_AGE:
                old.append((speed.t, f'SPEED {speed.value}, commanded {age:.2f} s before'))
    beats = [packet.t for packet in came if packet.type == HEARTBEAT]
    late, slowest, returns = [], 0.0, 0
    for event in events:
        if event.get('link') != 'network' or event['ev'] not in ('thawed', 'vanished'):
            continue
        if event['t'] + NETWORK_RETURN > end:
            continue
        returns += 1
        # What the lost connection had let through just before is no sign of its return.
        since = event['t'] + (0.1 if event['ev'] == 'vanished' else 0.0)
        at = bisect_left(beats, since)
        took = beats[at] - event['t'] if at < len(beats) else 1e9
        slowest = max(slowest, took)
        if took > NETWORK_RETURN:
            late.append((event['t'], f'no heartbeat for {min(took, end - event["t"]):.1f} s'))
    return [Row('network', 'no SPEED older than 1.5 s reaches a board behind socket://', tries, old,
                f'oldest {oldest:.2f} s'),
            Row('network', 'heartbeats within 3 s of its return', returns, late,
                f'{slowest:.2f} s' if returns else '')]


def registered(state: Any, parameters: Any, node: str) -> FrozenSet[Tuple[str, str]]:
    """What a master knows of a node: (topics published, subscribed, services, parameters; name)."""
    known = {(kind, name) for kind, entries in zip(('publishes', 'subscribes', 'offers'), state)
             for name, nodes in entries if node in nodes}
    return frozenset(known | {('parameter', key) for key in parameters})


def check_master(events: List[Dict], anew: List[Connection]) -> List[Row]:
    """A roscore that is restarted.

    Args:
        anew: connections that had no reason.
    """
    late, again, slowest, tries = [], [], 0.0, 0
    for index, event in enumerate(events):
        if event['ev'] != 'master started':
            continue
        tries += 1
        back = next((later for later in events[index:] if later['ev'] == 'registered'), None)
        took = back['t'] - event['t'] if back else 1e9
        slowest = max(slowest, took)
        if took > MASTER_RETURN:
            late.append((event['t'], 'topics, services and parameters came back after '
                         f'{took:.1f} s' if back else 'nothing of the bridge came back'))
        gone = max(one['t'] for one in events[:index] if one['ev'] == 'master ended')
        until = back['t'] if back else event['t'] + MASTER_RETURN
        again += [(one.t, f'the port of the {one.link} link was opened anew') for one in anew
                  if gone < one.t < until]
    return [Row('master', 'roscore restarted: topics, services, parameters back within 10 s', tries,
                late, f'{slowest:.1f} s' if tries and not late else ''),
            Row('master', 'no port is opened anew meanwhile', tries, again)]
