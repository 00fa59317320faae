"""The cost of a byte does not grow with the bytes before it, in any stream.

Where possible the cost is counted, not timed: lines of Python that run, and calls, each of which
costs about as much as ten lines. C code inside one call is timed: the time per byte of a long read
is compared with that of short reads. Hypothesis looks for more expensive streams; with
SERIAL_COMMUNICATION_FUZZ_EXAMPLES=100000 it searches for hours.
"""
import sys
import time
from functools import lru_cache

import hypothesis
import pytest
from hypothesis import strategies as st

from worst_streams import worst_streams

_CALL = 10          # lines
_SIZE = 8000
_LIMIT = 5          # times the cost of clean traffic
_TURNS = 15         # measurements of each time

_STREAMS = worst_streams(_SIZE)
_CLEAN = {case.link: case for case in _STREAMS}
# Bytes with a meaning in one of the protocols, and their neighbours.
_SPECIAL = (*range(13), 14, 16, 23, 24, 0x20, 0x21, 0x22, 0x55, 0x5A, 0xA5, 0xFD, 0xFE, 0xFF)
# Hypothesis 4 (Ubuntu 20.04) has no target(): it searches at random.
_PREFER = getattr(hypothesis, 'target', lambda ratio, label: None)


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


@pytest.mark.parametrize('link', _CLEAN)
@hypothesis.given(unit=st.lists(st.one_of(st.sampled_from(_SPECIAL), st.integers(0, 255)),
                                min_size=1, max_size=24).map(bytes))
def test_no_stream_costs_much_more_than_valid_frames(link, unit):
    case, size = _CLEAN[link], 1500
    cost = work(case.decoder, (unit * size)[:size], 500)
    ratio = cost / work(case.decoder, case.clean[:size], 500)
    _PREFER(ratio, label=link)
    assert ratio <= _LIMIT


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
