"""The cost of a byte does not grow with the bytes before it, in any stream.

Where possible the cost is counted, not timed: lines of Python that run, and calls, each of which
costs about as much as ten lines. C code inside one call is timed: the time per byte of a long read
is compared with that of short reads.
"""
import sys
import time
from functools import lru_cache

import pytest

from worst_streams import worst_streams

_CALL = 10          # lines
_SIZE = 8000
_LIMIT = 5          # times the cost of clean traffic
_TURNS = 15         # measurements of each time

_STREAMS = worst_streams(_SIZE)
_CLEAN = {case.link: case for case in _STREAMS}


def pieces(stream, size):
    return [stream[at:at + size] for at in range(0, len(stream), size)]


@lru_cache(maxsize=200)         # clean traffic is the same for many cases
def work(make, stream, chunk):
    """Lines a byte that decoding takes; a call counts as ten lines."""
    counts = {'line': 0, 'call': 0, 'c_call': 0}

    def count(_frame, event, _argument):
        if event in counts:
            counts[event] += 1
        return count

    decoder = make()
    before, chunks = sys.gettrace(), pieces(stream, chunk)
    sys.settrace(count)
    try:
        for piece in chunks:
            decoder.feed(piece)
    finally:
        sys.settrace(before)
    lines, decoder = counts['line'], make()
    counts.update(call=0, c_call=0)
    before = sys.getprofile()
    sys.setprofile(count)
    try:
        for piece in chunks:
            decoder.feed(piece)
    finally:
        sys.setprofile(before)
    return (lines + _CALL * (counts['call'] + counts['c_call'])) / len(stream)


@pytest.mark.parametrize('chunk', [1, 4096], ids=('byte by byte', 'in reads of 4096'))
@pytest.mark.parametrize('case', _STREAMS, ids=lambda case: '%s: %s' % (case.link, case.name))
def test_the_worst_streams_cost_at_most_five_times_clean_traffic(case, chunk):
    size = _SIZE if chunk > 1 else _SIZE // 4
    clean = work(case.decoder, case.clean[:size], chunk)
    worst = work(case.decoder, case.worst[:size], chunk)
    assert worst <= _LIMIT * clean


def seconds(make, chunks):
    """Processor time of this thread."""
    decoder = make()
    begun = time.thread_time()
    for piece in chunks:
        decoder.feed(piece)
    return time.thread_time() - begun


@pytest.mark.parametrize('case', [
    case for case in worst_streams(1 << 20) if case.name in (
        'the other kind of flag and noise in turn', 'one kind of flag and noise in turn',
        'STX and ETX in turn', 'no end', 'log texts of control characters')],
    ids=lambda case: '%s: %s' % (case.link, case.name))
def test_a_byte_costs_the_same_in_one_read_of_a_megabyte(case):
    """The cost is that in reads of four kilobytes, within a factor of three.

    Other work of the machine only adds to a time, so the least of several times counts. A cost that
    grows with the size of the read would be 256 times as high.
    """
    part = case.worst[:1 << 17]
    small = large = float('inf')
    for _ in range(_TURNS):
        small = min(small, seconds(case.decoder, pieces(part, 4096)) / len(part))
        large = min(large, seconds(case.decoder, [case.worst]) / len(case.worst))
        if large <= 3 * max(small, 2e-9):
            return
    assert large <= 3 * max(small, 2e-9)
