"""The sensor board's frames."""
import struct
from math import nan

import pytest
from by_definition import xor_of
from hypothesis import given
from hypothesis import strategies as st

from protocol_cases import MCU, check_case, check_rejected, decode, no_errors
from decoding import hexed, vectors
from serial_communication.boards.mcu import wire as mcu
from serial_communication.framing.stream import CHECKSUM, FRAMING, UNKNOWN

VECTORS = vectors('mcu')

uint16 = st.integers(0, 0xFFFF)
hundredths = st.integers(-0x8000, 0x7FFF)
seqs = st.integers(0, 255)


def sealed(type_, seq, payload, length=None):
    """A frame by the definition; `length` replaces its LEN."""
    body = bytes((type_, seq)) + payload
    return bytes((2, len(body) if length is None else length)) + body + bytes((xor_of(body), 3))


def status(raw_yaw=0, raw_pitch=0, raw_roll=0, range_1=100, range_2=200, seq=0):
    return sealed(0x10, seq, struct.pack('<HHhhh', range_1, range_2, raw_yaw, raw_pitch,
                                         raw_roll))


def message_of(frame):
    value = frame['value']
    if frame['type'] == 0x01:
        return mcu.AdcStatus(*value['adc'])
    return mcu.SensorStatus(value['vl53_1'], value['vl53_2'], value['yaw'], value['pitch'],
                            value['roll'])


@pytest.mark.parametrize('frame', VECTORS['frames'], ids=lambda frame: frame['frame'][:20])
def test_vectors_both_ways(frame):
    wire, message = hexed(frame['frame']), message_of(frame)
    assert mcu.encode(message, frame['seq']) == wire
    assert sealed(frame['type'], frame['seq'], wire[4:-2]) == wire
    check_case(MCU, wire, message, frame['type'], frame['seq'], wire[4:-2])


@pytest.mark.parametrize('case, cause', zip(VECTORS['rejected'], (CHECKSUM, FRAMING)),
                         ids=lambda case: case['name'] if isinstance(case, dict) else case)
def test_rejected_vectors(case, cause):
    check_rejected(MCU, hexed(case['frame']), cause)


# -- LEN and TYPE ---------------------------------------------------------------------------------

def test_a_len_under_2_is_detected_at_the_third_byte():
    decoder = mcu.Decoder()
    decoder.feed(b'\x02\x01\x10')
    assert not decoder.begun
    assert [frame.cause for frame in decoder.give_up()] == [FRAMING]


def test_a_wrong_len_of_a_known_type_is_detected_at_once():
    decoder = mcu.Decoder()
    decoder.feed(bytes((2, 200, 0x10)))
    assert not decoder.begun
    assert [frame.cause for frame in decoder.feed(status())] == [FRAMING, '']


@pytest.mark.parametrize('type_', [0, 2, 3, 0x11, 0xFC])
@pytest.mark.parametrize('size', [0, 1, 253])
def test_a_frame_of_an_unknown_type_is_one_error(type_, size):
    payload = bytes(value % 200 + 4 for value in range(size))
    wire = sealed(type_, 5, payload)
    assert mcu.encode_raw(type_, 5, payload) == wire
    check_rejected(MCU, wire, UNKNOWN)
    frame, = mcu.Decoder().feed(wire)
    assert (frame.raw, frame.type, frame.number, frame.data) == (wire, type_, 5, payload)


# -- values ---------------------------------------------------------------------------------------

def test_yaw_over_the_whole_int16_range():
    """A yaw under -180° is a heading that wrapped; any other is not changed."""
    for raw in range(-0x8000, 0x8000):
        message = mcu.SensorStatus.unpack(struct.pack('<HHhhh', 1, 2, raw, 3, 4))
        heading = raw + 65536 if raw < -18000 else raw
        if heading <= 36000:
            assert message.yaw == heading / 100
            assert message.pack()[4:6] == struct.pack('<h', raw)
        else:
            assert message.yaw == (heading - 36000) / 100


def test_pitch_and_roll_do_not_wrap():
    (frame,), _ = decode(MCU, status(0, -20000, -30000))
    assert (frame.message.pitch, frame.message.roll) == (-200.0, -300.0)


@pytest.mark.parametrize('ranges, valid', [
    ((0, 0), True), ((0xFFFE, 8190), True), ((0xFFFF, 8190), False), ((1, 0xFFFF), False)])
def test_a_status_is_valid_unless_a_range_sensor_timed_out(ranges, valid):
    (frame,), _ = decode(MCU, status(range_1=ranges[0], range_2=ranges[1]))
    assert frame.message.valid == valid


@pytest.mark.parametrize('yaw', [0, -0x8000, 9000])
def test_pitch_and_roll_of_the_marker_are_unknown_angles(yaw):
    (frame,), errors = decode(MCU, status(yaw, -0x8000, -0x8000, 400, 500))
    message = frame.message
    assert errors == no_errors(MCU)
    assert message == mcu.SensorStatus(400, 500, nan, nan, nan)
    assert not message.angles_known and not message.valid
    assert message.pack() == struct.pack('<HHhhh', 400, 500, 0, -0x8000, -0x8000)


@pytest.mark.parametrize('pitch, roll', [(-0x8000, 0), (0, -0x8000), (-0x7FFF, -0x8000)])
def test_one_angle_of_the_marker_is_an_angle(pitch, roll):
    (frame,), _ = decode(MCU, status(0, pitch, roll))
    assert frame.message == mcu.SensorStatus(100, 200, 0.0, pitch / 100, roll / 100)
    assert frame.message.valid


@given(uint16, uint16, hundredths, hundredths, hundredths, seqs)
def test_sensor_status_round_trip(range_1, range_2, yaw, pitch, roll, seq):
    if pitch == roll == -0x8000:
        yaw = 0    # of unknown angles it means nothing
    if -29536 < yaw < -18000:
        yaw = 0    # a heading over 360°
    wire = status(yaw, pitch, roll, range_1, range_2, seq)
    frames, errors = decode(MCU, wire, end=False)
    assert [(frame.type, frame.number) for frame in frames] == [(0x10, seq)]
    assert mcu.encode(frames[0].message, seq) == wire
    assert errors == no_errors(MCU)
