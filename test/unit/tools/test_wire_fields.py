"""The parts of valid, invalid and incomplete frames, of noise, and of frames of another board."""

import crane_scale
import pytest
from hypothesis import given
from hypothesis import strategies as st

from serial_communication.boards.arduino import wire as arduino
from serial_communication.tools.wire.fields import Explainer
from serial_communication.tools.wire.lines import Settings
from wire_lines import settings


def explainer(link, sent=False, **parameters):
    return Explainer(settings(link)._replace(parameters=parameters), sent)


LINES = {'bus': explainer('bus'), 'bus, sent': explainer('bus', True), 'mcu': explainer('mcu'),
         'bus with CMD2': explainer('bus', reply_has_cmd2=True), 'arduino': explainer('arduino'),
         'arduino, sent': explainer('arduino', True),
         'scale': Explainer(Settings(crane_scale.DESCRIPTION, 0), False)}


def check_whole(frame, parts):
    """The parts are in order, without gaps, and cover the whole frame."""
    at = 0
    for part in parts:
        assert part.start == at and part.end >= at and part.name
        at = part.end
    assert at == len(frame)


def errors_of(parts):
    return [part.error for part in parts if part.error]


@pytest.mark.parametrize('frame', [
    arduino.encode(arduino.Imu(16384, 0, 0, 0, *range(7))), arduino.encode_raw(1, b'x' * 255),
    arduino.encode_raw(1, b'x' * 253 + b'\0')], ids=['IMU', 'longest', 'long COBS code'])
def test_a_packet_is_explained_as_far_as_it_goes(frame):
    """For the vectors of all links, see test_wire_explain."""
    for size in range(1, len(frame) + 1):
        parts = LINES['arduino'].parts(frame[:size])
        check_whole(frame[:size], parts)
        assert any('missing' in error for error in errors_of(parts)) == (size < len(frame))
    assert errors_of(parts) == []


@pytest.mark.parametrize('line', LINES)
@given(frame=st.binary(max_size=60), start=st.sampled_from((
    b'', b'\xa5', b'\xa5\2\x55\x20', b'\x5a', b'\2\x0c\x10', b'\2\x0e\1', b'\2\2', b'\6\x0a',
    b'\3\x09', b'\5\1\xff', b'\0\0\2\x09', b':0200')))
def test_the_parts_of_any_bytes_are_complete_and_an_incomplete_frame_has_an_error(
        line, frame, start):
    frame = start + frame
    parts = LINES[line].parts(frame)
    check_whole(frame, parts)
    if not errors_of(parts) and frame:
        # The damage left a frame, whose message may be refused.
        decoder = LINES[line].decoder
        decoder.reset()
        assert [each.raw for each in decoder.feed(frame)] == [frame]
