"""What was published against what the boards sent. Pure functions over records (see records.py)."""
from typing import Dict, List, Tuple

from .align import Sent, align
from .records import Intervals
from .table import Row

_OLD = 0.5       # s that a frame may have waited when it is published: a stall is 0.3 s


def check_published(group: str, says: str, topics: Dict[str, Tuple[List[Sent], List]],
                    held_up: Intervals = Intervals(), stopped: Intervals = Intervals(),
                    late: float = 3.0) -> Tuple[Row, int, int]:
    """Every frame that has to be published was: once, in order, with its own values.

    Args:
        topics: by name, what was sent and the (stamp, key, time of arrival) of what was
            published.
        held_up: when the bridge, or the line, was stopped: what came late then is no figure.
        stopped: when the bridge was. What waited in its ports meanwhile is old, and not published.
        late: seconds after which a message can no more be of a frame, stops aside.

    Returns:
        The row, how many messages were published of damage that nobody can see, and how many
        of frames whose own bytes were right but not those around them.
    """
    tries, worst, held, blind, maybe = 0, 0.0, 0.0, 0, 0
    # A line that is stopped keeps what is on it for as long.
    late += max([over - start for start, over in held_up.pairs], default=0.0)
    violations: List[Tuple[float, str]] = []
    for name, (sent, published) in topics.items():
        found = align(sent, published, late=late)
        tries += sum(1 for one in sent if one.must)
        violations += [(sent[i].t, f'{name}: frame {sent[i].n} was not published: {sent[i].key}')
                       for i in found.lost]
        violations += [(published[j][0], f'{name}: published, but no frame says so: '
                        f'{published[j][1]}') for j in found.extra]
        held = max([held] + [one[2] - one[0] for one in published
                             if len(one) > 2 and not held_up.touches(one[0], one[2])])
        for i, j in found.pairs:
            if _waited(sent[i].t, published[j][0], stopped) and not _sent_again(
                    sent, i, published[j][0]):
                violations.append((published[j][0], f'{name}: frame {sent[i].n} was published '
                                   f'{published[j][0] - sent[i].t:.2f} s later, after a stall'))
            if sent[i].must and _lonely(sent, i) and not held_up.holds(sent[i].t):
                worst = max(worst, published[j][0] - sent[i].t)
            blind += sent[i].kind == 'blind'
            maybe += sent[i].kind == 'maybe'
    return Row(group, says, tries, sorted(violations),
               f'{worst * 1e3:.0f} ms from the board to the stamp, '
               f'{held * 1e3:.0f} ms on to a subscriber'), blind, maybe


def _waited(sent: float, published: float, stopped: Intervals) -> bool:
    """Whether a frame waited in the port of a bridge that was stopped."""
    return published - sent > _OLD and any(
        start <= sent <= over <= published for start, over in stopped.pairs)


def _sent_again(sent: List[Sent], i: int, published: float) -> bool:
    """Whether the same value was sent once more before it was published."""
    for one in sent[i + 1:]:
        if one.t > published:
            return False
        if one.key == sent[i].key:
            return True
    return False


def _lonely(sent: List[Sent], i: int) -> bool:
    """Whether no neighbour has the same value: only then is it sure which one was published."""
    key = sent[i].key
    return all(one.key != key for one in sent[max(i - 3, 0):i] + sent[i + 1:i + 4])
