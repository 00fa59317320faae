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


@pytest.mark.parametrize('build, direction, amount', [
    (lift, 2, 10), (lift, -1, 10), (lift, 0, 256), (lift, 0, -1), (gimbal, 4, 10),
    (gimbal, 3, 256)])
def test_moves_out_of_range_are_refused(build, direction, amount):
    with pytest.raises(ValueError):
        build(direction, amount)


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
        with pytest.raises(ValueError):
            encode(message)


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


@pytest.mark.parametrize('cmd2', [0x20, 0x21, 0x22, 0xFF])
def test_no_row_may_take_what_a_built_in_function_has(cmd2):
    with pytest.raises(RowError):
        DESCRIPTION.read('functions', {'a': {'cmd2': cmd2, 'srv_type': 'std_srvs/Trigger'}})
