"""`explain` names the parts of valid, invalid and incomplete frames, and of noise."""
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol_cases import ALL, CHECKSUMMED, BUS, decode, hexed, name_of
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.bus import wire as bus
from serial_communication.framing.stream import Decoder, StreamDecoder


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
        parts = arduino.Decoder().explain(frame[:size])
        check_whole(frame[:size], parts)
        assert any('missing' in error for error in errors_of(parts)) == (size < len(frame))
    assert errors_of(parts) == []


@pytest.mark.parametrize('kind', ALL, ids=name_of)
@given(frame=st.binary(max_size=60), start=st.sampled_from((
    b'', b'\xa5', b'\xa5\2\x55\x20', b'\x5a', b'\2\x0c\x10', b'\2\x0e\1', b'\2\2', b'\6\x0a',
    b'\3\x09', b'\5\1\xff', b'\0\0\2\x09')))
def test_the_parts_of_any_bytes_are_complete_and_an_invalid_frame_has_an_error(kind, frame, start):
    frame = start + frame
    parts = kind.make().explain(frame)
    check_whole(frame, parts)
    frames, errors = decode(kind, frame)
    if not errors_of(parts) and frame.strip(b'\0'):
        # The damage left a valid frame: then the decoder accepts it, too.
        assert [good.raw for good in frames] == [frame.lstrip(b'\0')]


@pytest.mark.parametrize('damage, name', [
    (1, 'Datelen'), (2, 'Checksum'), (5, 'Checksum'), (6, 'Checksum')])
def test_the_damaged_part_of_a_request_has_the_error(damage, name):
    frame = bytearray(bus.encode_request(bus.lift(0, 100)))
    frame[damage] ^= 0xFD if damage == 1 else 0x10
    parts = bus.RequestDecoder().explain(bytes(frame))
    assert [part.name for part in parts if part.error][0] == name


def test_the_parts_of_replies():
    reading = bus.encode_reply(bus.Reply(bus.OK, bus.Environment(350, 25.63, 48.12).pack()))
    for request, meaning in ((None, 'if it is an environment reply'),
                             (bus.ENVIRONMENT_REQUEST, '')):
        parts = BUS.make().explain(reading, request)
        assert [(part.name, part.value, part.meaning) for part in parts[3:6]] == [
            ('smoke', 350, meaning), ('temperature', 25.63, meaning),
            ('humidity', 48.12, meaning)]
    parts = BUS.make().explain(reading, bus.lift(0, 1))
    assert [part.name for part in parts[3:-1]] == ['DATE']
    parts = BUS.make().explain(bus.encode_reply(bus.Reply(bus.ERROR, b'\2\x80'))[:-1] + b'\0')
    assert [(part.name, part.value, part.meaning, part.error) for part in parts[3:]] == [
        ('error code', 0x8002, 'the operation failed', ''), ('Checksum', 0, '', 'should be 0x26')]


def test_the_part_with_an_impossible_value_has_the_error():
    parts = arduino.Decoder().explain(arduino.encode(arduino.SteeringAngle(2000)))
    assert [(part.name, part.error) for part in parts if part.error] == [
        ('value', 'value is 2000, out of range (0 … 1024)')]
    parts = arduino.Decoder().explain(arduino.encode(arduino.Imu(*[0] * 11)))
    assert [part.name for part in parts if part.error] == ['quaternion w']


# -- a decoder without an `explain`, as another package's may be ---------------------------


def test_the_parts_around_the_payload_without_an_explain_of_the_decoder():
    for frame in map(hexed, ('a50255200064b6', '020c109c2f003a0000000dfff3009803')):
        kind = bus.RequestDecoder if frame[0] == 0xA5 else mcu.Decoder
        good, = kind().feed(frame)
        parts = StreamDecoder.explain(kind(), frame)
        check_whole(frame, parts)
        assert [part.name for part in parts] == ['start', 'payload', 'end']
        assert (parts[1].data, parts[1].meaning) == (good.data, str(good.message))
        for size in range(1, len(frame)):
            assert ['missing' in error for error in errors_of(
                StreamDecoder.explain(kind(), frame[:size]))] == [True]


@pytest.mark.parametrize('kind', CHECKSUMMED, ids=name_of)
@given(frame=st.binary(max_size=60), start=st.sampled_from((b'', b'\xa5', b'\x5a', b'\2\x0c\x10')))
def test_explaining_any_bytes_does_not_change_the_pending_ones(kind, frame, start):
    frame, decoder = start + frame, kind.make()
    decoder.feed(kind.false_start)
    before = decoder.front, decoder.needed, dict(decoder.errors)
    parts = StreamDecoder.explain(decoder, frame)
    check_whole(frame, parts)
    assert before == (decoder.front, decoder.needed, decoder.errors) and decoder.pending
    frames, _ = decode(kind, frame)
    assert frame == b'' or bool(errors_of(parts)) == ([good.raw for good in frames] != [frame])


def test_a_decoder_that_is_no_stream_decoder_shows_a_frame_as_one_part():
    class Other(Decoder):
        pass

    assert [(part.name, part.data) for part in Other().explain(b'abc')] == [('frame', b'abc')]
