"""The cost of a byte does not grow with the bytes before it, in any stream.

The cost is counted, not timed: lines of Python that run, and calls, each of which costs about as
much as ten lines.
"""
import sys
from functools import lru_cache

import pytest

from worst_streams import worst_streams

_CALL = 10          # lines
_SIZE = 8000
_LIMIT = 5          # times the cost of clean traffic

_STREAMS = worst_streams(_SIZE)


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
