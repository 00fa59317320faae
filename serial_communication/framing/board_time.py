"""When a board measured something, from the time of its own clock.

A read is late by whatever held the bytes back: an adapter, a network, a starved process. Delays
only ever add, and the two clocks differ by a rate that hardly changes. So the line below all points
(board time, arrival) of the last seconds, their lower convex hull, belongs to the bytes that were
delayed least, and gives the time of all others.

Sources: E. Olson, "A Passive Solution to the Sensor Synchronization Problem", IROS 2010;
ethz-asl/cuckoo_time_translator, whose ConvexHullOwt also uses the edge in the middle.
"""
from bisect import bisect_left
from math import inf
from typing import List, Optional, Tuple

WINDOW = 10.0         # s of points that are used
LEAST_POINTS = 10     # before a time is returned, and
LEAST_SPAN = 1.0      # s that they span at least
MOST_DRIFT = 0.01     # a Nano has a ceramic resonator, good to 0.5 %
MOST_JUMP = 1.0       # s between the two clocks from one point to the next; more is a reset
MOST_OLDER = 0.1      # s before the newest time; a time that is older is that of a board begun anew
MOST_EARLY = 0.01     # s that bytes may seem to arrive before they are sent; else a time is wrong
MOST_DELAY = 1.0      # s; a frame that seems to have been delayed more is not believed
_SECONDS_A_TICK = 1e-6
_WRAP = 2 ** 32 * _SECONDS_A_TICK      # s after which the board's clock begins again at 0

_Point = Tuple[float, float]     # board time, arrival


class BoardClock:
    """The clock of one board. All times are in s of one monotonic clock of ours.

    A point costs a constant time on average: it enters the hull once and leaves it once.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all points: the port was opened, the bridge stalled, or the board began anew."""
        self._hull: List[_Point] = []
        self._points = 0
        self._is_known = False
        self._first = 0.0                           # board time of the first point
        self._newest: _Point = (-inf, -inf)
        self._returned = -inf                      # the latest time returned
        self._slope = 1.0

    @property
    def drift(self) -> float:
        """How much faster the board's clock runs than ours, in ppm."""
        return (1 / self._slope - 1) * 1e6

    def measured_at(self, ticks: int, arrival: float) -> Optional[float]:
        """Return when the board's clock was at `ticks`, or None if that is not known.

        The result is never after `arrival`. That of a later time is never an earlier one.

        Args:
            ticks: µs, modulo 2 ** 32.
            arrival: when the frame began on the wire at the latest.
        """
        board = self._unwrapped(ticks * _SECONDS_A_TICK, arrival)
        is_newest = board >= self._newest[0]
        if not self._is_known and is_newest:
            self._add((board, arrival))
        if not self._is_known:
            return None
        at = self._on_line(board)
        if at > arrival + MOST_EARLY:
            self.reset()
            return None
        at = min(at, arrival)
        if is_newest:
            self._add((board, arrival))
            at = self._returned = max(at, self._returned)
        return at

    def _unwrapped(self, board: float, arrival: float) -> float:
        """Return the board time without wraps; reset if all points are old or the clock jumped."""
        board_before, arrival_before = self._newest
        elapsed = arrival - arrival_before
        if elapsed <= WINDOW:
            step = board - board_before
            step += round((elapsed - step) / _WRAP) * _WRAP
            if step >= -MOST_OLDER and abs(step - elapsed) <= MOST_JUMP + MOST_DRIFT * elapsed:
                return board_before + step
        self.reset()
        return board

    def _add(self, point: _Point) -> None:
        hull = self._hull
        if not hull:
            self._first = point[0]
        while len(hull) > 1 and not _is_below(hull[-1], hull[-2], point):
            hull.pop()
        if hull and hull[-1][0] == point[0]:     # of two at one time the earlier arrival counts
            point = min(point, hull.pop())
        hull.append(point)
        oldest = point[0] - WINDOW
        while hull[0][0] < oldest and len(hull) > 2:
            del hull[0]
        self._newest = point
        if not self._is_known:
            self._points += 1
            self._is_known = self._points >= LEAST_POINTS and point[0] - self._first >= LEAST_SPAN

    def _on_line(self, board: float) -> float:
        """Extend the hull's edge in the middle of the points to this time.

        An edge that is too steep or too flat is not one of the two clocks. Then the lowest line
        of the nearest permitted slope is used.
        """
        hull = self._hull
        at = bisect_left(hull, ((hull[0][0] + board) / 2,), 1, len(hull) - 1)
        (board_0, arrival_0), (board_1, arrival_1) = hull[at - 1], hull[at]
        slope = (arrival_1 - arrival_0) / (board_1 - board_0)
        self._slope = min(max(slope, 1 - MOST_DRIFT), 1 + MOST_DRIFT)
        if self._slope == slope:
            return arrival_0 + slope * (board - board_0)
        return min(point[1] + self._slope * (board - point[0]) for point in hull)


def _is_below(point: _Point, left: _Point, right: _Point) -> bool:
    """Whether `point` is below the line from `left` to `right`."""
    return ((point[1] - left[1]) * (right[0] - left[0])
            < (right[1] - left[1]) * (point[0] - left[0]))
