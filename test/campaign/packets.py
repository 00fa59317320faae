"""What reached the model car's end of the line, and when it could not take it in: a journal's
packets. Pure functions over records (see records.py)."""
from bisect import bisect_right
from typing import Dict, Iterable, List, NamedTuple, Optional, Tuple

from serial_communication.boards.arduino import wire as arduino
from .records import Intervals

# Message types, from the protocol's own table.
SPEED, STEERING, LED, STEERING_ANGLE, TICKS, IMU, VOLTAGE, HEARTBEAT, CALIBRATION = range(4, 13)
OWN_COMMAND = 62         # of a message of one's own
PRESS = 0x40             # CMD2 of a bus function of one's own

GAP = 0.030              # s without a heartbeat after which the board stops its motor
CROSSING = 0.010         # s that a byte may take from one end of the line to the other


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


def heartbeats(journal: List[Dict]) -> List[float]:
    """When each came."""
    return sorted({packet.t for packet in packets_of(journal)[0] if packet.type == HEARTBEAT})


def line_times(beats: List[float], written: List[float]) -> Intervals:
    """When the line itself was late: a heartbeat had been written in time and came much later.

    A pseudo terminal passes bytes on in a kernel thread of ordinary priority, which competes
    with whatever else this machine runs. A serial line does not.

    Args:
        beats: when heartbeats came; `written`: when the bridge had handed them to its port.
    """
    pairs = []
    for before, after in zip(beats, beats[1:]):
        if after - before < 2 * CROSSING:
            continue
        at = bisect_right(written, before + 0.003)
        # The one written before this gap may be the one that ended it, too.
        if at and at < len(written) and written[at] - written[at - 1] < GAP and \
                written[at] - before < GAP and after - written[at] > CROSSING:
            pairs.append((written[at], after))
    return Intervals(pairs)
