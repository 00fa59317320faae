"""Runs robots in virtual time, by seeds, and judges what the bridge did."""
import argparse
import multiprocessing
import random
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any, Dict, Iterator, List, NamedTuple, Optional

_TEST = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(_TEST.parent), str(_TEST / 'sim'), str(_TEST / 'helpers')]

from evidence import Evidence  # noqa: E402  pylint: disable=wrong-import-position
from invariants import ALL, judge  # noqa: E402
from life import live  # noqa: E402

SECONDS = 25.0      # of each robot


class Result(NamedTuple):
    """What one seed gave."""

    seed: int
    seconds: float              # of robots
    tries: Dict[str, int]       # by invariant
    broken: Dict[str, str]      # the first violation of each


def run(seed: int, seconds: float = SECONDS, hertz: float = 10.0) -> Result:
    """Live and judge one seed."""
    tries: Dict[str, int] = Counter()
    broken: Dict[str, str] = {}
    stories = live(seed, seconds, hertz)
    for story in stories:
        for name, tried, words in judge(Evidence(story)):
            tries[name] += tried
            if words:
                broken.setdefault(name, f'{story.kind} on a {story.device.kind}: {words}')
    return Result(seed, seconds * len(stories), dict(tries), broken)


def table(results: List[Result]) -> Iterator[str]:
    """The lines of a table: invariant, tries, violated, and the first seed."""
    yield f'{"promise":64} {"tries":>9} {"violated":>9}  first seed'
    for invariant in ALL:
        name = invariant.__name__
        seeds = [result.seed for result in results if name in result.broken]
        promise = ' '.join((invariant.__doc__ or '').split()).rstrip('.')
        yield (f'{promise[:64]:64} {sum(result.tries.get(name, 0) for result in results):9,} '
               f'{len(seeds):9}  {seeds[0] if seeds else ""}')


def main(arguments: Optional[List[str]] = None) -> int:
    """Run fresh seeds on all processors, and print the table."""
    parser = argparse.ArgumentParser(prog='soak', description=__doc__)
    parser.add_argument('--hours', type=float, default=1 / 60, help='how long (a minute)')
    parser.add_argument('--seed', type=int, help='the first seed; by default a random one')
    parser.add_argument('--seeds', type=int, help='so many seeds instead of a time')
    options = parser.parse_args(arguments)
    first = random.randrange(10 ** 9) if options.seed is None else options.seed
    end = time.monotonic() + options.hours * 3600
    seeds = iter(range(first, first + (options.seeds or 10 ** 9)))
    results: List[Result] = []
    with multiprocessing.Pool() as pool:
        for result in pool.imap_unordered(run, seeds, chunksize=4) if options.seeds else \
                _until(pool, seeds, end):
            results.append(result)
            for name, words in result.broken.items():
                print(f'seed {result.seed}: {name}: {words}', flush=True)
    hours = sum(result.seconds for result in results) / 3600
    print(f'{len(results)} seeds from {first}: {hours:.1f} hours of links', *table(results),
          sep='\n')
    violated = sum(len(result.broken) for result in results)
    print(f'{violated} violated')
    return min(violated, 1)


def _until(pool: Any, seeds: Iterator[int], end: float) -> Iterator[Result]:
    while time.monotonic() < end:
        yield from pool.map(run, [next(seeds) for _ in range(40)], chunksize=4)


if __name__ == '__main__':
    sys.exit(main())
