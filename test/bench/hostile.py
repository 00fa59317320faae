"""What the worst bytes that anyone can send cost a decoder, beside normal traffic."""
import time
from functools import lru_cache
from typing import Any, Callable

from tabulate import tabulate

from worst_streams import worst_streams

LIMIT = 5.0              # times the cost of normal traffic
_SIZE = 1 << 20          # bytes
_READ = 4096             # bytes; what a tty gives at once


def hostile() -> bool:
    """Print what each stream costs; return whether none costs too much."""
    costs = [(stream.link, stream.name, nanoseconds(stream.decoder, stream.clean),
              nanoseconds(stream.decoder, stream.worst)) for stream in worst_streams(_SIZE)]
    print(tabulate([(*cost, cost[3] / cost[2]) for cost in costs],
                   ('link', 'stream', 'normal, ns/byte', 'worst, ns/byte', 'times'),
                   floatfmt=('', '', '.0f', '.0f', '.1f')))
    return all(worst <= LIMIT * normal for _link, _name, normal, worst in costs)


@lru_cache(maxsize=None)        # normal traffic is the same for all streams of a decoder
def nanoseconds(make: Callable[[], Any], stream: bytes) -> float:
    """CPU time of this thread for each byte."""
    decoder, began = make(), time.thread_time()
    for at in range(0, len(stream), _READ):
        decoder.feed(stream[at:at + _READ])
    return (time.thread_time() - began) / len(stream) * 1e9
