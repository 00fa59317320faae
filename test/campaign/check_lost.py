"""The frames that the mcu link lost, as the bridge counts them. Pure functions over records.

No time is compared with another one. Which connection a frame belongs to, and after how many
frames a status was made, is what the bridge itself says; after which restart of the board a
frame was sent is what the board's journal says.
"""
from collections import Counter
from itertools import accumulate
from typing import Any, Dict, List, NamedTuple, Tuple

from .table import Row

_SEARCHED = 400     # frames around the guess in which the records' beginning is looked for


class Heard(NamedTuple):
    """A good frame, as serial_msg shows it."""

    t: float            # of its arrival, for people
    connection: str     # of the bridge's port
    frame: Tuple        # type, SEQ, payload
    n: int = -1         # its running number in the board's journal; -1: noise with a right CRC
    boot: int = 0       # how often the board had started before it sent this


class Told(NamedTuple):
    """What one status on /diagnostics says."""

    t: float            # of its arrival, for people
    received: int       # good frames since the bridge started
    lost: int


def heard_of(journal: List[Dict], taken: List[Tuple[float, str, Tuple]]) -> List[Heard]:
    """`taken`, (arrival, connection, frame), with what the board's journal knows of each."""
    sent: Dict[Tuple, List[Tuple[float, int, int]]] = {}
    boot = 0
    for event in journal:
        if event['ev'] == 'boot':
            boot += 1
        elif event['ev'] == 'tx':
            frame = event['type'], event['seq'], bytes.fromhex(event['raw'])[4:-2]
            sent.setdefault(frame, []).append((event['t'], event['n'], boot))
    found = []
    for t, connection, frame in taken:
        before = [one for one in sent.get(frame, []) if one[0] <= t]
        _at, n, boot = before[-1] if before else (0.0, -1, 0)
        found.append(Heard(t, connection, frame, n, boot))
    return found


def check_lost_frames(heard: List[Heard], told: List[Told]) -> List[Row]:
    """The bridge counts the frames that it lost as SEQ says, and SEQ says what the board sent."""
    if len(heard) < 2 or not told:
        return []
    gaps = [0]
    violations = []
    tries = 0
    for before, after in zip(heard, heard[1:]):
        if before.connection != after.connection or before.frame == after.frame:
            gaps.append(0)          # what is lost with a port is not counted; doubled on the line
            continue
        tries += 1
        gaps.append((after.frame[1] - before.frame[1] - 1) % 256)
        sent = after.n - before.n - 1
        if min(before.n, after.n) >= 0 and before.boot == after.boot and gaps[-1] != sent % 256:
            violations.append((after.t, f'SEQ says {gaps[-1]} lost, the board sent {sent} in '
                                        'between'))
    lost = list(accumulate(gaps))
    violations += _miscounts(heard, lost, told)
    return [Row('mcu', 'lost frames are counted as the board counted them', tries, violations,
                f'{lost[-1]} lost')]


def _miscounts(heard: List[Heard], lost: List[int], told: List[Told]) -> List[Tuple[float, str]]:
    """Statuses whose two counts do not fit each other.

    How many frames the bridge had received before the records begin is not known. With the right
    number every status fits, so the number with which the most do is taken.

    Args:
        lost: up to and with each frame of `heard`.
    """
    def judged(unseen: int) -> List[Tuple[float, str]]:
        within = [(one, one.received - unseen) for one in told
                  if 0 < one.received - unseen <= len(heard)]
        if not within:
            return [(told[0].t, 'no status of this time')]
        earlier = Counter(one.lost - lost[seen - 1] for one, seen in within).most_common(1)[0][0]
        found = []
        # The two counts of a status are read one after the other, and frames may come between;
        # not as many as come until the next status, which is made later.
        for (one, seen), (_next, following) in zip(within, within[1:] + [(None, len(heard))]):
            least, most = lost[max(seen - 2, 0)], lost[following - 1]
            if not least <= one.lost - earlier <= most:
                found.append((one.t, f'the bridge counted {one.lost - earlier} lost frames, the '
                                     f'board {lost[seen - 1]}'))
        return found

    seen_first = sum(one.t <= told[0].t for one in heard)
    guess = told[0].received - seen_first
    return min((judged(guess + off) for off in _nearest_first(_SEARCHED)), key=len)


def _nearest_first(most: int) -> List[int]:
    """0, 1, -1, 2 …: of numbers with which equally many fit, the likeliest is the first."""
    return [0] + [sign * off for off in range(1, most) for sign in (1, -1)]


def frame_of(message: Any) -> Tuple:
    """Type, SEQ and payload of a SerialMsg."""
    return message.type, message.command, bytes(message.data)
