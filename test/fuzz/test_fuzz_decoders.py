"""No stream costs a decoder much more than valid frames.

The cost is counted in work, not measured as time: hypothesis gets the cost of each stream and looks
for a more expensive one. With SERIAL_COMMUNICATION_FUZZ_EXAMPLES=100000 it searches for hours.
"""
import sys
from functools import lru_cache

import hypothesis
import pytest
from fuzz_streams import SPECIAL
from hypothesis import given
from hypothesis import strategies as st

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.bus import wire as bus

# Hypothesis 4 (Ubuntu 20.04) has no target(): it searches at random.
_PREFER = getattr(hypothesis, 'target', None)
_LIMIT = 5               # times the work for valid frames
_CALL = 10               # a call counts as this many lines
_SIZE = 1500             # bytes of the stream

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


@lru_cache(maxsize=8)        # clean traffic is counted once
def work(make, stream):
    """The lines of Python executed per byte, with _CALL lines for each call, in reads of 500."""
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


@pytest.mark.parametrize('name', DECODERS)
@given(unit=st.lists(st.one_of(st.sampled_from(SPECIAL), st.integers(0, 255)), min_size=1,
                     max_size=24).map(bytes))
def test_no_stream_costs_much_more_than_valid_frames(name, unit):
    make, clean = DECODERS[name]
    cost = work(make, (unit * (_SIZE // len(unit) + 1))[:_SIZE])
    ratio = cost / work(make, (clean * (_SIZE // len(clean) + 1))[:_SIZE])
    if _PREFER:
        _PREFER(ratio, label=name)
    assert ratio <= _LIMIT
