"""The times of measurement that a board's clock gives, with clocks and delays of the test."""
import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as some

from serial_communication.framing.board_time import WINDOW, BoardClock

PERIOD = 0.01     # s between two measurements
SECONDS = some.floats(0, 0.3)


class Board:
    """A board that measures each PERIOD of its own clock."""

    def __init__(self, drift=0.0, ticks=0, wander=0.0, seed=1):
        self.now = 1000.0
        self.drift = drift
        self._wander = wander
        self._board = ticks * 1e-6
        self._random = random.Random(seed)

    def measure(self, seconds=PERIOD):
        """Return the true time and the board's."""
        self.drift += self._random.gauss(0, self._wander)
        self._board += seconds
        self.now += seconds / (1 + self.drift)
        return self.now, round(self._board * 1e6) % 2 ** 32


def errors_of(clock, board, delays):
    """The error of each time returned, in s; the delays are those of the arrivals."""
    errors, newest = [], 0.0
    for delay in delays:
        true, ticks = board.measure()
        newest = max(newest, true + delay)       # a line keeps the order
        at = clock.measured_at(ticks, newest)
        if at is not None:
            errors.append(at - true)
    return errors


def usual(seed=1, least=0.0, typical=3e-5):
    """Delays of a quiet line."""
    source = random.Random(seed)
    while True:
        yield least + source.expovariate(1 / typical)


def take(count, delays):
    return [next(delays) for _ in range(count)]


def p99(errors):
    return sorted(abs(error) for error in errors)[len(errors) * 99 // 100]


@given(some.lists(some.tuples(some.integers(0, 2 ** 32 - 1), SECONDS), max_size=60))
def test_a_time_is_never_after_the_arrival(points):
    clock, now = BoardClock(), 5.0
    for ticks, elapsed in points:
        now += elapsed
        at = clock.measured_at(ticks, now)
        assert at is None or at <= now


@given(some.lists(some.tuples(some.integers(1, 100_000), some.floats(0, 0.1), SECONDS),
                  min_size=20, max_size=200))
def test_a_later_time_is_never_returned_earlier(points):
    clock, now, ticks, newest, arrival = BoardClock(), 5.0, 0, -math.inf, 0.0
    for step, elapsed, delay in points:
        now, ticks = now + elapsed, ticks + step
        arrival = max(now + delay, arrival)
        at = clock.measured_at(ticks, arrival)
        if at is not None:
            assert at >= newest
            newest = at


@given(some.floats(-0.0095, 0.0095), some.lists(SECONDS, min_size=150, max_size=250))
def test_whatever_the_delays_are_one_in_a_hundred_without_delay_is_enough(drift, delays):
    for at in range(0, len(delays), 50):
        delays[at] = 0.0
    errors = errors_of(BoardClock(), Board(drift), delays)
    assert all(error > -1e-4 for error in errors)


@given(some.floats(0.001, 0.3), some.floats(0.001, 0.6), some.integers(200, 1500))
def test_a_delay_never_makes_a_time_later(delay, more, count):
    times = []
    for last in delay, delay + more:
        clock, board = BoardClock(), Board(drift=0.003)
        errors_of(clock, board, take(count, usual()))
        true, ticks = board.measure()
        times.append(clock.measured_at(ticks, true + last))
    assert times[0] == pytest.approx(times[1], abs=1e-9)
    assert abs(times[0] - true) < 3e-4


@pytest.mark.parametrize('before', [1, 50, 500])
def test_the_boards_clock_wraps(before):
    board = Board(drift=-0.004, ticks=2 ** 32 - round(before * PERIOD * 1e6))
    errors = errors_of(BoardClock(), board, take(1500, usual()))
    assert len(errors) >= 1399 and p99(errors) < 3e-4


@pytest.mark.parametrize('batch, wander, limit, most_uneven', [
    (0, 3e-6, 3e-4, 5e-5), (0.001, 3e-6, 6e-4, 1e-4), (0.016, 3e-6, 2.5e-3, 3e-4),
    (0, 0, 5e-5, 1e-5), (0.001, 0, 1e-4, 3e-5), (0.016, 0, 6e-4, 2e-4)])
def test_a_line_that_delivers_in_batches(batch, wander, limit, most_uneven):
    """The stamps are right, and their distances still more so."""
    board = Board(drift=0.004, wander=wander)
    delays, clock, errors = usual(least=2e-4), BoardClock(), []
    newest = 0.0
    for index in range(6000):
        true, ticks = board.measure()
        arrival = true + next(delays)
        if batch:
            arrival = math.ceil(arrival / batch) * batch + next(delays) - 2e-4
        if index % 500 < 8:     # a stall of 80 ms each 5 s
            arrival += (8 - index % 500) * PERIOD
        newest = max(newest, arrival)
        at = clock.measured_at(ticks, newest)
        if at is not None:
            errors.append(at - true - 2e-4)
    assert p99(errors) < limit
    distances = sorted(abs(after - before) for before, after in zip(errors, errors[1:]))
    assert distances[len(distances) * 999 // 1000] < most_uneven


@pytest.mark.parametrize('jump', [-2 ** 31, -1_100_000, -120_000, 1_100_000, 2 ** 31])
def test_a_clock_that_jumps_begins_again(jump):
    clock, board = BoardClock(), Board(ticks=5_000_000)
    errors_of(clock, board, take(300, usual()))
    true, ticks = board.measure()
    other = Board(ticks=ticks + jump)
    other.now = true
    errors = errors_of(clock, other, take(150, usual()))
    assert 49 <= len(errors) <= 51 and p99(errors) < 1e-4


@pytest.mark.parametrize('dead', [0.12, 0.3, 0.9])
@pytest.mark.parametrize('points', [1, 2, 5, 10])
def test_a_board_that_is_reset_just_after_its_start_begins_again(points, dead):
    """As when the current of its motors makes its supply fail: its clock is hardly set back."""
    clock, board = BoardClock(), Board()
    errors_of(clock, board, take(points, usual()))
    other = Board()
    other.now = board.now + dead
    errors = errors_of(clock, other, take(300, usual()))
    assert 190 <= len(errors) <= 202 and p99(errors) < 3e-4


@pytest.mark.parametrize('older', [1e-6, 0.003, 0.09])
def test_a_time_older_than_the_one_before_is_no_jump(older):
    """As of a value that was measured in an interrupt, and sent behind another one."""
    clock, board = BoardClock(), Board(drift=0.002)
    for _ in range(300):
        true, ticks = board.measure()
        at = clock.measured_at(ticks, true + 1e-4)
        before = clock.measured_at((ticks - round(older * 1e6)) % 2 ** 32, true + 2e-4)
    assert at == pytest.approx(true, abs=3e-4)
    assert before == pytest.approx(at - older, abs=1e-3)


@pytest.mark.parametrize('bit', range(32))
def test_a_time_with_a_wrong_bit_makes_no_other_time_wrong(bit):
    """The packets of the car have no checksum. It is as if the clock had jumped there and back."""
    clock, board = BoardClock(), Board(drift=0.002)
    errors = errors_of(clock, board, take(400, usual()))
    true, ticks = board.measure()
    clock.measured_at(ticks ^ 1 << bit, true)
    errors += errors_of(clock, board, take(400, usual()))
    assert len(errors) > 690 and -0.0045 < min(errors) <= max(errors) < 1e-3


@pytest.mark.parametrize('seed', range(3))
def test_with_one_time_in_ten_damaged_in_one_byte_stamps_are_no_worse_than_those_of_the_reads(
        seed):
    """The line stands for 80 ms each 5 s. test/bench/board_time.py measures more lines."""
    clock, board, source = BoardClock(), Board(0.004, wander=3e-6), random.Random(seed)
    stamps, reads, arrival = [], [], 0.0
    for index in range(3000):
        true, ticks = board.measure(0.05)
        late = max(1e-4, 0.08 - (index % 100 + source.random()) * 0.05)
        arrival = max(arrival, true + late)
        if source.random() < 0.1:
            ticks ^= source.randrange(1, 256) << 8 * source.randrange(4)
        at = clock.measured_at(ticks, arrival)
        stamps.append((arrival if at is None else at) - true)
        reads.append(arrival - true)
    assert p99(stamps) <= p99(reads)


@pytest.mark.parametrize('ppm', [-9000, -40, 0, 5000])
def test_the_drift_is_told(ppm):
    clock, board = BoardClock(), Board(drift=ppm * 1e-6)
    errors_of(clock, board, take(1200, usual()))
    assert clock.drift == pytest.approx(ppm, abs=20)


@pytest.mark.parametrize('slower', [0.15, 0.3, 0.9])
def test_stamps_follow_a_line_that_got_slower_for_good(slower):
    """A delay that grows by more than the drift explains in the window."""
    clock, board = BoardClock(), Board()
    errors_of(clock, board, take(1500, usual()))
    errors_of(clock, board, take(round((WINDOW + 3) / PERIOD), usual(least=slower)))
    errors = errors_of(clock, board, take(100, usual(least=slower)))
    assert len(errors) == 100 and all(abs(error - slower) < 0.01 for error in errors)


@pytest.mark.parametrize('ahead', [0.01, 0.03, 0.3])
def test_a_first_time_that_is_ahead_makes_no_other_time_early(ahead):
    """Nothing confirms it, so all begins again without it."""
    clock, board = BoardClock(), Board(drift=0.002)
    for index in range(300):
        true, ticks = board.measure()
        at = clock.measured_at(ticks + (round(ahead * 1e6) if index == 0 else 0), true)
        assert at is None or at == pytest.approx(true, abs=3e-4)
    assert at is not None
