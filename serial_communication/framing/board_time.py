"""When a board measured something, from the time of its own clock.

A read is late by whatever held the bytes back: an adapter, a network, a starved process. Delays
only ever add, and the two clocks differ by a rate that hardly changes. So the line below all points
(board time, arrival) of the last seconds, their lower convex hull, belongs to the bytes that were
delayed least, and gives the time of all others.

A damaged value that seems ahead would hold the line down until the window is over. So a point that
is out of place is doubted: it is dropped, unless the next one is out of place by the same. The
first one needs another one near its line.

Sources: E. Olson, "A Passive Solution to the Sensor Synchronization Problem", IROS 2010;
ethz-asl/cuckoo_time_translator, whose ConvexHullOwt uses the edge in the middle.
"""
from bisect import bisect_left
from math import inf
from typing import List, Optional, Tuple

WINDOW = 10.0         # s of points that are used
DRAWN_EVERY = 0.1     # s after which the line below them is drawn anew
EDGE = 0.3            # its place: of the window, before the newest point
SMOOTHED = 0.5        # s in which the times move over to a new line, exponentially
LEAST_POINTS = 10     # before a time is returned, and
LEAST_SPAN = 1.0      # s that they span at least
MOST_DRIFT = 0.01     # a Nano has a ceramic resonator, good to 0.5 %
MOST_JUMP = 1.0       # s that a point may be later than the one before; more is a reset
LEAST_JUMP = 0.1      # s; the same before a time is returned, of an older time, and below the line
MOST_BELOW = 0.005    # s that one point may lie below the line; two may, if they agree so well
MOST_DELAY = 1.0      # s; a frame that seems to have been delayed more is not believed
_HALF = 2 ** 31       # µs; after twice that the board's clock begins again at 0

_Point = Tuple[float, float]     # board time, arrival


class BoardClock:
    """The clock of one board. All times are in s, those of ours of one monotonic clock.

    A point costs a constant time on average: each time the line is drawn, the point that was
    delayed least since the last time enters the hull, and each leaves it once.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all points: the port was opened, the bridge stalled, or the board began anew."""
        self._hull: List[_Point] = []
        self._least: _Point = (0.0, 0.0)           # delayed least since the line was drawn
        self._least_delay = inf
        self._points = 0
        self._is_known = self._is_confirmed = False
        self._doubted: Optional[Tuple[int, float]] = None     # ticks, arrival of the latest point
        self._ticks = 0                            # of the newest point
        self._newest: _Point = (0.0, -inf)         # board times are from the first point on
        self._returned = -inf                      # the latest time returned
        self._on_line: _Point = (0.0, 0.0)         # a point of the line
        self._slope = 1.0
        self._drawn_until = -inf                   # board time until which the line holds

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
        elapsed = arrival - self._newest[1]
        if elapsed > WINDOW:       # all points are old
            self._begin(ticks, arrival)
            return None
        step = _seconds(self._ticks, ticks)
        late = elapsed - step
        board = self._newest[0] + step
        delay = arrival - self._line_at(board)
        drift = MOST_DRIFT * elapsed
        has_jumped = late > drift + (MOST_JUMP if self._is_known else LEAST_JUMP) \
            or step < 0.0 and late > LEAST_JUMP or delay < -LEAST_JUMP
        before, self._doubted = self._doubted, None
        if has_jumped or delay < -MOST_BELOW - drift:
            self._doubted = ticks, arrival
            if before is None or abs(
                    arrival - before[1] - _seconds(before[0], ticks)) > MOST_BELOW + drift:
                return None
            if has_jumped:         # the board began anew, at the point before
                self._begin(*before)
                return self.measured_at(ticks, arrival)
        if step >= 0.0:
            self._add(ticks, (board, arrival), delay)
        if not self._is_known:
            return None
        at = self._line_at(board)
        if self._returned > -inf and step < SMOOTHED:
            # An older time keeps its distance from the newest.
            at += (self._returned + self._slope * step - at) * min(1 - step / SMOOTHED, 1.0)
        at = min(at, arrival)
        if step >= 0.0:
            at = self._returned = max(at, self._returned)
        return at

    def _begin(self, ticks: int, arrival: float) -> None:
        self.reset()
        self._add(ticks, (0.0, arrival), 0.0)

    def _line_at(self, board: float) -> float:
        return self._on_line[1] + self._slope * (board - self._on_line[0])

    def _add(self, ticks: int, point: _Point, delay: float) -> None:
        """Add the newest point."""
        self._ticks = ticks
        self._newest = point
        self._is_confirmed |= self._points > 0 and delay < MOST_BELOW
        if delay < self._least_delay:
            self._least_delay = delay
            self._least = point
        if delay <= 0.0 and not self._is_known:     # it was delayed least so far
            self._on_line = point
        if point[0] >= self._drawn_until:
            self._draw_line()

    def _draw_line(self) -> None:
        """Extend an edge of the hull: a late one follows the drift, an early one has less noise.

        An edge that is too steep or too flat is not one of the two clocks. Then the lowest line
        of the nearest permitted slope is used.
        """
        hull = self._hull
        _add_to_hull(hull, self._least)
        self._least_delay = inf
        self._points += 1
        board = self._newest[0]
        while len(hull) > 2 and hull[1][0] < board - WINDOW:     # its edge is below no point
            del hull[0]
        if self._points < LEAST_POINTS or board < LEAST_SPAN:
            return
        if not self._is_confirmed:     # the first point may be damaged: all others are later
            self.reset()
            return
        self._is_known = True
        self._drawn_until = board + DRAWN_EVERY
        place = board - EDGE * min(WINDOW, board - hull[0][0])
        at = bisect_left(hull, (place,), 1, len(hull) - 1)
        (board_0, arrival_0), (board_1, arrival_1) = hull[at - 1], hull[at]
        slope = (arrival_1 - arrival_0) / (board_1 - board_0)
        self._slope = min(max(slope, 1 - MOST_DRIFT), 1 + MOST_DRIFT)
        self._on_line = hull[at]
        if self._slope != slope:
            # What is before the window is of another delay, or of another rate.
            inside = hull[1:] if hull[0][0] < board - WINDOW else hull
            self._on_line = min(inside, key=lambda point: point[1] - self._slope * point[0])


def _add_to_hull(hull: List[_Point], point: _Point) -> None:
    """Add a point that is not before the last one."""
    board, arrival = point
    while len(hull) > 1:
        (board_0, arrival_0), (board_1, arrival_1) = hull[-2:]
        if ((arrival_1 - arrival_0) * (board - board_0)
                < (arrival - arrival_0) * (board_1 - board_0)):
            break      # the last one is below the line from the one before to this one
        hull.pop()
    if hull and hull[-1][0] == board:     # of two at one time the earlier arrival counts
        point = min(point, hull.pop())
    hull.append(point)


def _seconds(before: int, after: int) -> float:
    """The time from one number of ticks to another, which may be the earlier one."""
    return ((after - before + _HALF) % (2 * _HALF) - _HALF) / 1e6
