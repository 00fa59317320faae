"""The model car's packets: every type and its limits."""
import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol_cases import (ARDUINO, ARDUINO_CHECKED, BOARD_ARDUINO, check_case, check_rejected,
                            decode, no_errors)
from decoding import hexed, vectors
from serial_communication.boards.arduino import wire as arduino
from serial_communication.framing import cobs
from serial_communication.framing.stream import FRAMING, IMPLAUSIBLE, LENGTH, OVERSIZE, UNKNOWN

VECTORS = vectors('arduino')['packets']
IMU_VECTOR = [packet for packet in VECTORS if packet['type'] == 9][0]
TO_BOARD = (4, 5, 6, 11, 12)
NAMES = 'DEBUG', 'INFO', 'WARN', 'ERROR'

int16 = st.integers(-0x8000, 0x7FFF)
uint16 = st.integers(0, 0xFFFF)
printable = st.text(st.characters(blacklist_categories=('Cc', 'Cs', 'Zl', 'Zp', 'Cn', 'Zs', 'Cf',
                                                        'Co')), max_size=60)


def message_of(packet):
    """The typed message that a vector describes."""
    type_, value = packet['type'], packet.get('value')
    if type_ < 4:
        return arduino.LOGS[type_](value)
    if type_ == 9:
        return arduino.Imu(*struct.unpack('>11h', hexed(packet['payload'])))
    if type_ == 10:
        return arduino.Voltage(struct.unpack('<f', struct.pack('<f', value))[0])
    classes = {4: arduino.SpeedCommand, 5: arduino.SteeringCommand, 6: arduino.LedCommand,
               7: arduino.SteeringAngle, 8: arduino.Ticks}
    if type_ in classes:
        return classes[type_](value)
    return {11: arduino.Heartbeat, 12: arduino.ImuCalibration}[type_]()


def wire_of(type_, data):
    return cobs.encode(bytes((type_,)) + data) + b'\0'


@pytest.mark.parametrize('packet', VECTORS, ids=lambda packet: packet['wire'][:20])
def test_vectors_both_ways(packet):
    wire, message = hexed(packet['wire']), message_of(packet)
    assert arduino.encode(message) == wire
    kind = BOARD_ARDUINO if packet['type'] in TO_BOARD else ARDUINO
    check_case(kind, wire, message, packet['type'], 0, hexed(packet['payload']))


def test_the_imu_vector_in_si_units():
    imu, value = message_of(IMU_VECTOR), IMU_VECTOR['value']
    x, y, z, w = imu.orientation()
    assert dict(x=x, y=y, z=z, w=w) == pytest.approx(value['orientation'])
    for measured, name in ((imu.angular_velocity(), 'angular_velocity'),
                           (imu.linear_acceleration(), 'linear_acceleration')):
        assert dict(zip('xyz', measured)) == pytest.approx(value[name])
    assert imu.temperature() == pytest.approx(value['temperature'])
    # Rates scale with the parameter, and with nothing else.
    assert imu.angular_velocity(2.0) == pytest.approx((2.0 * imu.gy, -2.0 * imu.gx, 2.0 * imu.gz))


def test_the_imu_vector_is_implausible_by_default():
    """Its quaternion has a norm of 0.91."""
    check_rejected(ARDUINO_CHECKED, hexed(IMU_VECTOR['wire']), IMPLAUSIBLE)


# -- round trips ---------------------------------------------------------------------------------

from_board = st.one_of(
    st.builds(lambda severity, text: arduino.LOGS[severity](text), st.integers(0, 3), printable),
    st.builds(arduino.SteeringAngle, uint16), st.builds(arduino.Ticks, st.integers(0, 255)),
    st.builds(arduino.Imu, *[int16] * 11),
    st.builds(arduino.Voltage, st.floats(width=32, allow_nan=False)))
to_board = st.one_of(
    st.builds(arduino.SpeedCommand, int16), st.builds(arduino.SteeringCommand, uint16),
    st.builds(arduino.LedCommand,
              st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=30)),
    st.just(arduino.Heartbeat()), st.just(arduino.ImuCalibration()))


@pytest.mark.parametrize('messages, there, back', [
    (from_board, ARDUINO, BOARD_ARDUINO), (to_board, BOARD_ARDUINO, ARDUINO)],
    ids=('from the board', 'to the board'))
@given(data=st.data())
def test_round_trip_of_messages_that_the_other_side_does_not_know(messages, there, back, data):
    message = data.draw(messages)
    frames, errors = decode(there, arduino.encode(message), end=False)
    assert [(frame.type, frame.message) for frame in frames] == [(message.TYPE, message)]
    assert errors == no_errors(there)
    str(message)
    assert decode(back, arduino.encode(message))[1][UNKNOWN] == 1


# -- what is refused ------------------------------------------------------------------------------

@pytest.mark.parametrize('kind, types', [
    (ARDUINO, (0, 1, 2, 3, 7, 8, 9, 10, 253, 254, 255)), (BOARD_ARDUINO, (*TO_BOARD, 253))],
    ids=('ours', "board's"))
def test_every_other_type_is_unknown(kind, types):
    for type_ in range(256):
        frames, errors = decode(kind, wire_of(type_, b'\1'))
        assert errors[UNKNOWN] == (0 if type_ in types else 1), type_


@pytest.mark.parametrize('kind, type_, size', [
    (ARDUINO, 7, 2), (ARDUINO, 8, 1), (ARDUINO, 9, 22), (ARDUINO, 10, 4),
    (BOARD_ARDUINO, 4, 2), (BOARD_ARDUINO, 5, 2), (BOARD_ARDUINO, 11, 0), (BOARD_ARDUINO, 12, 0)])
def test_a_known_type_has_one_length(kind, type_, size):
    for wrong in {0, size - 1, size + 1, size + 20} - {-1, size}:
        check_rejected(kind, wire_of(type_, bytes(wrong)), LENGTH)
    assert len(decode(kind, wire_of(type_, bytes(size)))[0]) == 1


@pytest.mark.parametrize('encoded', [b'\1', b'\5\1\2', b'\xff' * 20])
def test_invalid_cobs_is_a_framing_error(encoded):
    check_rejected(ARDUINO, encoded + b'\0', FRAMING)


def test_a_packet_holds_at_most_256_bytes():
    for filler in (b'\0', b'x'):       # the longest and the shortest way to encode it
        largest = wire_of(1, filler * 255)
        frames, errors = decode(ARDUINO, largest)
        assert [frame.data for frame in frames] == [filler * 255]
        assert errors == no_errors(ARDUINO)
        for size in (256, 257, 600, 5000):
            ticks = arduino.encode(arduino.Ticks(3))
            frames, errors = decode(ARDUINO, ticks + wire_of(1, filler * size) + ticks)
            assert [frame.message for frame in frames] == [arduino.Ticks(3)] * 2
            assert errors == dict(no_errors(ARDUINO), **{OVERSIZE: 1})
            shown = []
            for step in 1, 10_000:      # bytes in each read
                wire, decoder = ticks + wire_of(1, filler * size) + ticks, arduino.Decoder()
                shown.append([(frame.raw, frame.error) for at in range(0, len(wire), step)
                              for frame in decoder.feed(wire[at:at + step])])
            assert shown[0] == shown[1]
    assert arduino.encode_raw(1, b'x' * 255) == wire_of(1, b'x' * 255)
    with pytest.raises(ValueError):
        arduino.encode_raw(1, b'x' * 256)


# -- plausibility ---------------------------------------------------------------------------------

def cause_of(message):
    """The error cause of a message with the default decoder; '' if it is valid."""
    frames, errors = decode(ARDUINO_CHECKED, arduino.encode(message))
    assert errors == dict(no_errors(ARDUINO_CHECKED), **{IMPLAUSIBLE: 0 if frames else 1})
    assert len(decode(ARDUINO, arduino.encode(message))[0]) == 1, 'valid without the check'
    return '' if frames else IMPLAUSIBLE


@pytest.mark.parametrize('message, plausible', [
    *((arduino.SteeringAngle(value), value <= 1024) for value in (0, 1024, 1025, 65535)),
    *((arduino.Voltage(volts), True) for volts in (0.0, -0.0, 100.0, 14.8)),
    *((arduino.Voltage(volts), False) for volts in (
        100.00001, -1e-9, -1.0, math.inf, -math.inf, 1e38)),
    (arduino.Imu(16384, 0, 0, 0, *[-32768] * 7), True), (arduino.Ticks(255), True)])
def test_angles_up_to_1024_and_0_to_100_v_are_plausible_and_other_values_have_no_limits(
        message, plausible):
    assert bool(cause_of(message)) != plausible


def test_a_nan_voltage_is_implausible():
    decoder = arduino.Decoder()
    frame, = decoder.feed(arduino.encode(arduino.Voltage(float('nan'))))
    assert frame.cause == IMPLAUSIBLE


@pytest.mark.parametrize('part', range(4))
@pytest.mark.parametrize('value, plausible', [
    (16384, True), (-16384, True),
    (math.ceil(0.95 * 16384), True), (math.ceil(0.95 * 16384) - 1, False),
    (math.floor(1.05 * 16384), True), (math.floor(1.05 * 16384) + 1, False),
    (0, False), (-32768, False)])
def test_a_plausible_quaternion_has_a_norm_within_5_percent_of_1(part, value, plausible):
    fields = [0] * 11
    fields[part] = value
    assert bool(cause_of(arduino.Imu(*fields))) != plausible


# -- texts ----------------------------------------------------------------------------------------

@pytest.mark.parametrize('data, text', [
    (b'DMP ready!\0', 'DMP ready!'), (b'no end', 'no end'), (b'', ''), (b'\0', ''),
    (b'line\r\n\0', 'line'), (b'line\n', 'line'),
    (b'a\0b\0', 'a'),
    (b'bell\7 \x1b[31mred\0', 'bell\ufffd \ufffd[31mred'), (b'tab\there\nthere', None),
    (b'bad \xff\xfe\0', 'bad \ufffd\ufffd'), (b'cut \xe2\x82\0', 'cut \ufffd'),
    ('25 °C'.encode(), '25 °C'), ('\x85\u2028\u202e'.encode(), '\ufffd' * 3)])
def test_log_texts_are_printable(data, text):
    for severity in range(4):
        (frame,), errors = decode(ARDUINO, wire_of(severity, data))
        assert errors == no_errors(ARDUINO)
        assert frame.message.TYPE == severity
        if text is not None:
            assert str(frame.message) == f'{NAMES[severity]} {text!r}'
        assert str(frame.message).isprintable()


@pytest.mark.parametrize('text', ['', 'left', 'x' * 30, '!~ ', 'a\tb\n\x7f'])
def test_led_texts_within_the_limits(text):
    assert arduino.LedCommand(text).pack() == text.encode() + b'\0'


@pytest.mark.parametrize('message', [
    *map(arduino.LedCommand, ('x' * 31, 'blink é', 'a\0b', 'x' * 1000000)),
    arduino.SpeedCommand(32768), arduino.SteeringCommand(-1), arduino.SteeringCommand(65536),
    arduino.Ticks(256), arduino.SteeringAngle(65536)])
def test_texts_and_numbers_beyond_their_limits_are_refused(message):
    with pytest.raises(ValueError):
        arduino.encode(message)


@pytest.mark.parametrize('text, taken', [
    (b'', True), (b'ready', True), ('Lenkung über 90°'.encode(), True), (b'a\x01', True),
    (b'100% \xb0C', True),      # one character of another encoding
    (b'\x8f', False), (b'a\x01\x02', False), (b'\x12\xfe\x90Q\x07\xb3\xc1', False)])
def test_a_mostly_unreadable_log_line_is_implausible(text, taken):
    for severity in range(4):
        frame, = arduino.Decoder().feed(wire_of(severity, text + b'\0'))
        assert frame.cause == ('' if taken else IMPLAUSIBLE)
        frame, = arduino.Decoder(check_plausibility=False).feed(wire_of(severity, text + b'\0'))
        assert not frame.cause
