"""robot-ctrl-bus: frames and messages of both directions."""
import struct

import pytest
from by_definition import xor_of
from hypothesis import given
from hypothesis import strategies as st

from bus_moves import gimbal, lift
from protocol_cases import BOARD_BUS, BUS, BUS_CMD2, check_case, check_rejected, decode
from decoding import hexed, vectors
from serial_communication.boards.bus import DESCRIPTION, wire as bus
from serial_communication.framing.rows import RowError
from serial_communication.framing.stream import CHECKSUM, FRAMING

VECTORS = vectors('robot_ctrl_bus')


def by_name(cases):
    return pytest.mark.parametrize('case', cases, ids=lambda case: case['name'])


def with_checksum(frame):
    """The frame with its checksum appended."""
    return frame + bytes((xor_of(frame),))


@by_name(VECTORS['requests'])
def test_request_vectors_both_ways(case):
    frame, data = hexed(case['frame']), hexed(case['data'])
    request = bus.Request(case['cmd1'], case['cmd2'], data)
    datelen = 0 if case['name'].endswith('Datelen 0x00') else 2
    assert bus.encode_request(request, datelen) == frame
    check_case(BOARD_BUS, frame, request, case['cmd1'], case['cmd2'], data)


@by_name(VECTORS['replies'])
def test_reply_vectors_both_ways(case):
    frame, data = hexed(case['frame']), hexed(case['data'])
    reply = bus.Reply(case['cmd1'], data)
    assert bus.encode_reply(reply) == frame
    assert reply.error_code == case.get('error', 0)
    check_case(BUS, frame, reply, case['cmd1'], 0, data)


@by_name(VECTORS['rejected'])
def test_rejected_vectors(case):
    wire = hexed(case['frame'])
    # The seed's example is longer than its Datelen: noise after the frame.
    rest = {FRAMING: 1} if len(wire) > 4 else {}
    check_rejected(BUS, wire, CHECKSUM, **rest)


def test_default_request_helpers_make_the_documented_frames():
    assert bus.encode_request(lift(0, 100)) == hexed('a5 02 55 20 00 64 b6')
    assert bus.encode_request(gimbal(3, 90)) == hexed('a5 02 55 21 03 5a 8a')
    assert bus.encode_request(bus.ENVIRONMENT_REQUEST) == hexed('a5 02 55 22 d0')
    assert bus.encode_request(bus.SYNC_REQUEST) == hexed('a5 00 00 00 a5')
    assert bus.encode_request(bus.echo(b'\xde\xad\xbe\xef')) == hexed(
        'a5 04 01 00 de ad be ef 82')


@pytest.mark.parametrize('build, direction, amount, text', [
    (lift, 2, 10, 'lift: direction is 2, out of range (0 … 1)'),
    (lift, -1, 10, 'direction is -1'),
    (lift, 0, 256, 'distance is 256, which its place (B) cannot hold'),
    (lift, 0, -1, 'distance is -1'),
    (gimbal, 4, 10, 'gimbal: direction is 4, out of range (0 … 3)'),
    (gimbal, 3, 256, 'angle is 256, which its place (B) cannot hold'),
])
def test_moves_out_of_range_are_refused_with_the_range(build, direction, amount, text):
    with pytest.raises(ValueError) as refusal:
        build(direction, amount)
    assert text in str(refusal.value)


# -- lengths ------------------------------------------------------------------------------

@pytest.mark.parametrize('size, start', [
    (0, 'a5 00'), (254, 'a5 fe'), (255, '5a ff 00'), (256, '5a 00 01'), (1024, '5a 00 04')])
def test_the_flag_follows_the_length(size, start):
    data = bytes(value % 251 for value in range(size))
    request, reply = bus.Request(0x77, 0x12, data), bus.Reply(bus.OK, data)
    wire = bus.encode_request(request)
    assert wire == with_checksum(hexed(start) + b'\x77\x12' + data)
    check_case(BOARD_BUS, wire, request, 0x77, 0x12, data)
    wire = bus.encode_reply(reply)
    assert wire == with_checksum(hexed(start) + b'\x02' + data)
    check_case(BUS, wire, reply, bus.OK, 0, data)


def test_more_than_the_longest_data_is_not_encoded():
    for encode, message in ((bus.encode_request, bus.Request(1, 0, bytes(1025))),
                            (bus.encode_reply, bus.Reply(1, bytes(1025)))):
        with pytest.raises(ValueError) as refusal:
            encode(message)
        assert '1025' in str(refusal.value) and '1024' in str(refusal.value)


@pytest.mark.parametrize('start', ['a5 ff', '5a fe 00', '5a 01 04', '5a ff ff'])
def test_an_invalid_datelen_is_detected_at_once_and_the_next_frame_found(start):
    decoder = bus.ReplyDecoder()
    assert decoder.feed(hexed(start)) == [] and not decoder.begun
    frames = decoder.feed(bus.encode_reply(bus.Reply(bus.OK)))
    assert [(frame.cause, frame.message) for frame in frames] == [
        (FRAMING, None), ('', bus.Reply(bus.OK))]
    assert not decoder.pending


# -- replies with CMD2, environment requests, error codes -------------------------------------

def test_a_reply_may_carry_cmd2():
    reply = bus.Reply(bus.OK, b'\1\2\3', 0x20)
    wire = bus.encode_reply(reply, has_cmd2=True)
    assert wire == with_checksum(hexed('a5 03 02 20 01 02 03'))
    check_case(BUS_CMD2, wire, reply, bus.OK, 0, b'\1\2\3')
    assert decode(BUS, wire)[0] == []


def test_an_environment_request_is_decoded_without_waiting_for_more_bytes():
    decoder = bus.RequestDecoder()
    wire = bus.encode_request(bus.ENVIRONMENT_REQUEST)
    assert [decoder.feed(wire[at:at + 1]) for at in range(4)] == [[]] * 4
    assert [frame.message for frame in decoder.feed(wire[4:])] == [bus.ENVIRONMENT_REQUEST]


@pytest.mark.parametrize('cmd1', [bus.ERROR, bus.INVALID])
@pytest.mark.parametrize('data, code', [
    ('', 0), ('40', 0x40), ('40 00', 0x40), ('00 80', 0x8000), ('02', 2), ('02 80', 0x8002),
    ('10', 0x10), ('10 00', 0x10)])
def test_error_codes_are_one_or_two_bytes_in_either_reply(cmd1, data, code):
    reply = bus.Reply(cmd1, hexed(data))
    assert reply.error_code == code
    assert bus.Reply(bus.OK, hexed(data)).error_code == 0
    assert '0x%02x' % code in str(reply)


@pytest.mark.parametrize('code', sorted(bus.ERROR_TEXTS))
def test_every_known_error_code_has_a_text(code):
    assert bus.describe_error(code) == '0x%02x: %s' % (code, bus.ERROR_TEXTS[code])
    assert 'not a code' in bus.describe_error(0x1234)


# -- the environment -----------------------------------------------------------------------------

def test_environment_values():
    assert bus.Environment.unpack(hexed('5e 01 03 0a cc 12')) == pytest.approx(
        (350, 25.63, 48.12))
    assert bus.Environment.unpack(hexed('ff ff 1e fb 10 27')) == (65535, -12.5, 100.0)
    for size in (0, 5, 7):
        with pytest.raises(struct.error):
            bus.Environment.unpack(bytes(size))


@given(st.integers(0, 65535), st.integers(-32768, 32767), st.integers(0, 65535))
def test_environment_round_trip(smoke, centidegrees, centipercent):
    packed = struct.pack('<HhH', smoke, centidegrees, centipercent)
    reading = bus.Environment.unpack(packed)
    assert reading.temperature == pytest.approx(centidegrees / 100)
    assert reading.humidity == pytest.approx(centipercent / 100)
    assert reading.pack() == packed


# -- damage ---------------------------------------------------------------------------------------

@pytest.mark.parametrize('message, text', [
    (lift(0, 100), 'lift up 100 mm'), (lift(1, 1), 'lift down 1 mm'),
    (gimbal(2, 30), 'gimbal up 30 degrees'), (bus.ENVIRONMENT_REQUEST, 'environment'),
    (bus.SYNC_REQUEST, 'SYNC'), (bus.echo(b'\xab'), 'ECHO ab'),
    (bus.Request(0x55, 0x20, b'\7\7'), 'lift 0707'),
    (bus.Reply(bus.ERROR, b'\2\x80'), 'ERROR 0x8002: the operation failed'),
    (bus.Reply(bus.INVALID, b'\x40'), 'INVALID 0x40: the checksum did not match'),
    (bus.Reply(bus.OK), 'OK'), (bus.Reply(0x77, b'\1'), 'reply 0x77 01')])
def test_texts_of_messages(message, text):
    assert str(message) == text


# -- functions -----------------------------------------------------------------------------------

@pytest.mark.parametrize('function', bus.BUILT_IN.values(), ids=lambda function: function.name)
def test_no_row_may_take_what_a_built_in_function_has(function):
    if function.cmd1 == bus.FUNCTION:
        row = {'cmd2': function.number, 'srv_type': 'std_srvs/Trigger'}
        with pytest.raises(RowError, match='from 0 to 254 but 32, 33, 34'):
            DESCRIPTION.read('functions', {'a': row})


def test_a_move_is_described_by_its_function():
    assert (bus.LIFT_FUNCTION.moves, bus.RAW.moves, bus.ECHO_FUNCTION.repeatable) == (
        True, False, True)
