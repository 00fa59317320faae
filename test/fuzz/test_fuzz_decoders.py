"""Any bytes at all into each decoder: nothing is raised, nothing grows, nothing gets stuck.

And a search for the stream that costs most, in work counted and not timed: hypothesis is told
what each unit costs and looks for a dearer one. SERIAL_COMMUNICATION_FUZZ_EXAMPLES=100000 makes
it look for hours.
"""
import sys
from functools import lru_cache

import hypothesis
import pytest
from fuzz_streams import TELLING, garbage
from hypothesis import given
from hypothesis import strategies as st

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.bus import wire as bus
from serial_communication.framing.stream import MAX_REPORTED

# Hypothesis 4, which Ubuntu 20.04 has, cannot be guided: it looks at random there.
_PREFER = getattr(hypothesis, 'target', None)
_LONGEST = 1030          # bytes of the longest frame there is
_LIMIT = 5               # times the work of clean traffic
_CALL = 10               # lines that a call counts as
_SIZE = 1500             # bytes whose work is counted

DECODERS = {
    'bus': (bus.ReplyDecoder, bus.encode_reply(
        bus.Reply(bus.OK, bus.Environment(350, 25.63, 48.12).pack()))),
    'bus with CMD2': (lambda: bus.ReplyDecoder(True), bus.encode_reply(
        bus.Reply(bus.OK, bytes(6), 0x22), True)),
    'board side of bus': (bus.RequestDecoder, bus.encode_request(bus.lift(0, 100))),
    'mcu': (mcu.Decoder, mcu.encode(mcu.SensorStatus(400, 500, 12.34, -2.43, 2.43), 7)),
    'arduino': (arduino.Decoder, arduino.encode(
        arduino.Imu(16384, 0, 0, 0, 10, -20, 30, 100, -200, 8192, -1290))
        + arduino.encode(arduino.Ticks(7)) + arduino.encode(arduino.SteeringAngle(512))),
    'board side of arduino': (arduino.BoardDecoder, arduino.encode(arduino.SpeedCommand(300))
                              + arduino.encode(arduino.Heartbeat()) * 5),
}
every_decoder = pytest.mark.parametrize('name', DECODERS)


def held(decoder):
    """Bytes, frames and stamps that it keeps."""
    return sum(len(value) for value in vars(decoder).values() if hasattr(value, '__len__'))


def settle(decoder):
    """Give up whatever is pending; how often that took."""
    count = 0
    while decoder.pending:
        decoder.give_up()
        count += 1
        assert count <= 4 * _LONGEST
    return count


@every_decoder
@given(pieces=st.lists(garbage, max_size=6))
def test_any_bytes(name, pieces):
    make, clean = DECODERS[name]
    decoder = make()
    for piece in pieces:
        frames = decoder.feed(piece)
        assert sum(len(frame.raw) for frame in frames) <= len(piece) + 3 * _LONGEST
        for frame in frames:
            str(frame.message)      # as serial_msg prints it
        # Stamps and counters beside the bytes of one frame, twice (each has an XOR), and noise.
        assert held(decoder) <= 2 * _LONGEST + MAX_REPORTED + len(frames) + 20
    settle(decoder)
    assert [frame.raw for frame in decoder.feed(b'\0' + clean) if not frame.cause]
    assert all(count >= 0 for count in decoder.errors.values())


@every_decoder
@given(data=garbage)
def test_a_good_frame_behind_garbage_is_found_after_a_pause(name, data):
    make, clean = DECODERS[name]
    decoder = make()
    decoder.feed(data)
    settle(decoder)
    found = b''.join(frame.raw for frame in decoder.feed(clean) if not frame.cause)
    assert found == clean


@lru_cache(maxsize=8)        # clean traffic is counted once
def work(make, stream):
    """Lines of Python run, and calls counted as lines, for each byte, in reads of 500."""
    counts = {'line': 0, 'call': 0, 'c_call': 0}

    def count(_frame, event, _argument):
        if event in counts:
            counts[event] += 1
        return count

    pieces = [stream[at:at + 500] for at in range(0, len(stream), 500)]
    for instrument, inspect in ((sys.settrace, sys.gettrace), (sys.setprofile, sys.getprofile)):
        decoder, before = make(), inspect()
        calls = counts['call']
        instrument(count)
        try:
            for piece in pieces:
                decoder.feed(piece)
        finally:
            instrument(before)
        if instrument is sys.settrace:
            counts['call'] = calls
    return (counts['line'] + _CALL * (counts['call'] + counts['c_call'])) / len(stream)


@every_decoder
@given(unit=st.lists(st.one_of(st.sampled_from(TELLING), st.integers(0, 255)), min_size=1,
                     max_size=24).map(bytes))
def test_no_stream_is_much_dearer_than_clean_traffic(name, unit):
    make, clean = DECODERS[name]
    dear = work(make, (unit * (_SIZE // len(unit) + 1))[:_SIZE])
    ratio = dear / work(make, (clean * (_SIZE // len(clean) + 1))[:_SIZE])
    if _PREFER:
        _PREFER(ratio, label=name)
    assert ratio <= _LIMIT
