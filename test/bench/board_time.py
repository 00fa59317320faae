"""How wrong the stamps are that a board's clock gives, beside those of the reads.

    /usr/bin/python3 test/bench/board_time.py [--runs 6]

A board measures 20 or 100 times a second, by a clock that is up to 5000 ppm off and wanders. Its
line stands for 80 ms each 5 s, and delivers at once, each 1 ms, each 16 ms, or as a network does.
"""
import argparse
import math
import random
import sys
from multiprocessing import Pool
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from serial_communication.framing.board_time import (  # noqa: E402  pylint: disable=C0413
    MOST_DELAY, BoardClock)

LINES = {'plain': 0.0, '1 ms': 0.001, '16 ms': 0.016, 'network': None}   # s; None: jitter
SECONDS = 120.0     # of a run
WANDER = 3e-5       # of the drift, in a second, at the standard deviation
LEAST = 1e-4        # s from the measurement to the read, at least


def points(hertz, batch, damaged, seed):
    """Yield the true time, the board's and that of the read, all as they arrive."""
    source = random.Random(seed)
    drift, board = source.uniform(-5e-3, 5e-3), source.uniform(0, 4294)
    true, newest = source.uniform(1000, 2000), 0.0
    for _ in range(round(SECONDS * hertz)):
        drift = min(max(drift + source.gauss(0, WANDER / hertz ** 0.5), -5e-3), 5e-3)
        board += 1 / hertz
        true += 1 / hertz / (1 + drift)
        arrival = true + LEAST
        if batch is None:
            arrival += source.expovariate(1 / 0.008)
        elif batch:
            arrival = math.ceil(arrival / batch) * batch
        arrival += source.expovariate(1 / 3e-5)
        if arrival % 5.0 < 0.08:
            arrival += 0.08 - arrival % 5.0
        newest = max(newest, arrival)       # a line keeps the order
        ticks = round(board * 1e6) % 2 ** 32
        is_damaged = source.random() < damaged
        if is_damaged:
            ticks ^= source.randrange(1, 256) << 8 * source.randrange(4)
        yield true, ticks, newest, is_damaged


def errors(arguments):
    """The errors of one run, in s: of the reads, of the stamps, of those not damaged themselves."""
    hertz, line, damaged, seed = arguments
    clock = BoardClock()
    found = []
    for true, ticks, arrival, is_damaged in points(hertz, LINES[line], damaged, seed):
        at = clock.measured_at(ticks, arrival)
        if at is None or arrival - at > MOST_DELAY:
            at = arrival
        found.append((arrival - true, at - true, is_damaged))
    return found


def described(values):
    """p50, p99 of the sizes, and the extremes, in ms."""
    sizes = sorted(abs(value) for value in values)
    return '{:7.2f} {:7.2f} {:+8.2f} {:+8.2f}'.format(
        *(1e3 * value for value in (sizes[len(sizes) // 2], sizes[len(sizes) * 99 // 100],
                                    min(values), max(values))))


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--runs', type=int, default=6, help='of each line (%(default)s)')
    runs = parser.parse_args().runs
    head = '{:>7} {:>7} {:>8} {:>8}'.format('p50', 'p99', 'early', 'late')
    print(f'errors, ms{"":18} {"reads":33} {"stamps":33} stamps of undamaged times')
    print(f'{"":28} {head}  {head}  {head}')
    with Pool() as pool:
        for damaged in 0.0, 0.1:
            for hertz in 20, 100:
                for line in LINES:
                    found = sum(pool.map(errors, [(hertz, line, damaged, seed)
                                                  for seed in range(runs)]), [])
                    columns = [[each[0] for each in found], [each[1] for each in found]]
                    if damaged:
                        columns.append([each[1] for each in found if not each[2]])
                    print(f'{line:8} {hertz:4} Hz {"damaged" if damaged else "":9}  ',
                          *map(described, columns), sep='  ')


if __name__ == '__main__':
    main()
