"""Holds what was published against what the board sent: both in order, neither complete.

Not everything that a board sends has to arrive, and a value may occur many times, so which
message came of which frame is a search: the pairing, in order, with the fewest faults.
"""
import heapq
from typing import Any, Dict, List, NamedTuple, Tuple

_BEHIND = 3000     # how far behind the foremost pairing another one may be


class Sent(NamedTuple):
    """What a board sent, or what damage made of it."""

    t: float
    key: Any
    must: bool           # it has to arrive; else it may
    kind: str = ''       # ok, maybe (its own bytes are right), blind (damage made it)
    n: int = 0           # the frame's running number


class Alignment(NamedTuple):
    """Indices of `sent` and `published`."""

    pairs: List[Tuple[int, int]]
    lost: List[int]      # of `sent`: had to arrive and did not
    extra: List[int]     # of `published`: come of nothing that was sent


def align(sent: List[Sent], published: List[Tuple[float, Any]], early: float = 0.01,
          late: float = 3.0) -> Alignment:
    """Pair equal keys in order, each published `-early` … `late` seconds after it was sent."""
    size, count = len(sent), len(published)
    came: Dict[Tuple[int, int], Tuple[int, int, bool]] = {}
    heap = [(0, 0, 0, 0)]
    foremost = 0
    pushed = {(0, 0): 0}
    done = (0, 0)
    while heap:
        cost, _order, i, j = heapq.heappop(heap)
        if i + j < foremost - _BEHIND or pushed.get((i, j), cost) < cost:
            continue
        here = (i, j)
        # As long as there is no choice.
        while i < size and j < count and sent[i].must and _equal(sent[i], published[j], early,
                                                                 late):
            i, j = i + 1, j + 1
        if (i, j) != here:
            if pushed.get((i, j), cost + 1) <= cost:
                continue
            pushed[i, j] = cost
            came[i, j] = here + (True,)
        foremost = max(foremost, i + j)
        done = (i, j)
        if i == size and j == count:
            break
        steps = []
        if i < size and j < count and not sent[i].must and _equal(sent[i], published[j], early,
                                                                  late):
            steps.append((0, i + 1, j + 1, True))
        # Too late for this frame means too late for all before it, and the other way round.
        if i < size and not (j < count and published[j][0] < sent[i].t - early):
            steps.append((1 if sent[i].must else 0, i + 1, j, False))
        if j < count and not (i < size and published[j][0] > sent[i].t + late):
            steps.append((1, i, j + 1, False))
        for price, a, b, match in steps:
            if pushed.get((a, b), cost + price + 1) > cost + price:
                pushed[a, b] = cost + price
                came[a, b] = (i, j, match)
                heapq.heappush(heap, (cost + price, -(a + b), a, b))
    return _trace(came, done, sent, published)


def _equal(one: Sent, other: Tuple[float, Any], early: float, late: float) -> bool:
    return one.key == other[1] and one.t - early <= other[0] <= one.t + late


def _trace(came, at: Tuple[int, int], sent: List[Sent], published) -> Alignment:
    pairs: List[Tuple[int, int]] = []
    while at != (0, 0):
        i, j, match = came[at]
        if match:
            pairs += [(at[0] - step, at[1] - step) for step in range(1, at[0] - i + 1)]
        at = (i, j)
    pairs.reverse()
    paired_sent, paired = {i for i, _j in pairs}, {j for _i, j in pairs}
    return Alignment(pairs,
                     [i for i, one in enumerate(sent) if one.must and i not in paired_sent],
                     [j for j in range(len(published)) if j not in paired])
