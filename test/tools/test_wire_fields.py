"""The parts of valid, invalid and incomplete frames, of noise, and of frames of another board."""

import crane_scale
import pytest
from hypothesis import given
from hypothesis import strategies as st

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.description import Description
from serial_communication.framing.layout import Value, message_class
from serial_communication.framing.stream import UNKNOWN, Good, Need, StreamDecoder
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


# -- a board of another package -------------------------------------------------------------------

Weight = message_class('Weight', 1, '<xH', [Value('value', 'kg', 0.1)], 'weight')


class _Decoder(StreamDecoder):
    """A '!', the type, three bytes of data and a '.'."""

    STARTS = b'!'

    def __init__(self):
        super().__init__()
        self.errors[UNKNOWN] = 0

    def frame_at(self, at):
        frame = self.buffer[at:at + 6]
        if len(frame) < 6:
            return Need(6)
        data = frame[2:5]
        return Good(6, frame[1], 0, data, Weight.unpack(data) if frame[1] == Weight.TYPE else None)


def test_another_board_has_the_values_of_its_message_or_the_whole_frame():
    another = Explainer(Settings(Description('x', 'x', lambda sent, _: _Decoder()), 0), False)
    assert [(part.name, part.data, part.value, part.unit) for part in another.parts(
        b'!\1\0\5\0.')] == [('start', b'!\1', None, ''), ('padding', b'\0', None, ''),
                            ('value', b'\5\0', 0.5, 'kg'), ('end', b'.', None, '')]
    assert [part.name for part in another.parts(b'!\2\0\5\0.')] == ['frame']
    assert [part.error for part in another.parts(b'!\2\0\5')] == ['missing, 2 bytes']
    assert [part.name for part in another.parts(b'abc')] == ['noise']
    hold = crane_scale.wire.encode(crane_scale.wire.Hold(), 0)     # in hex digits
    assert [(part.data, part.meaning) for part in LINES['scale'].parts(hold)] == [(hold, 'hold')]
