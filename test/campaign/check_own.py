"""Commands of one's own, as they reached the board. Pure functions over records."""
from bisect import bisect_right
from typing import Dict, List, Set

from .check_motor import KEPT
from .packets import OWN_COMMAND, Packet
from .records import Intervals
from .table import Row


def check_own_commands(came: List[Packet], commands: List[Dict], absent: Intervals,
                       unclear: Intervals) -> Row:
    """Each was commanded, just now, on this connection, and came once.

    Args:
        came: what reached the board.
        absent: when the port was; what comes before its return came by the connection of before.
        unclear: when the board could not take in at once what came.
    """
    published: Dict[int, List[float]] = {}
    for entry in commands:
        if entry['topic'] == 'winch' and entry['value']:    # 0 is none that its row allows
            published.setdefault(entry['value'], []).append(entry['t'])
    packets = [packet for packet in came if packet.type == OWN_COMMAND]
    violations, oldest = [], 0.0
    seen: Set[float] = set()
    for packet in packets:
        value = int.from_bytes(packet.data, 'big')
        times = published.get(value, [])
        at = bisect_right(times, packet.t) - 1
        if at < 0:
            violations.append((packet.t, f'winch {value}, which nobody commanded'))
            continue
        commanded = times[at]
        if commanded in seen:
            violations.append((packet.t, f'winch {value}, a second time'))
        seen.add(commanded)
        if not unclear.holds(packet.t):
            oldest = max(oldest, packet.t - commanded)
            if packet.t - commanded > KEPT:
                violations.append((packet.t, f'winch {value}, commanded '
                                             f'{packet.t - commanded:.2f} s before'))
        if absent.first_within(commanded, packet.t):
            violations.append((packet.t, f'winch {value}, commanded before the port went'))
    return Row('arduino', "a command of one's own: commanded just now, here, and sent once",
               len(packets), violations, f'oldest command {oldest * 1e3:.0f} ms')
