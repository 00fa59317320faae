"""Settings: from a row to bytes and back, and every mistake in a row."""
import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from board_rows import car_settings as arduino_settings
from board_rows import mcu_settings
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.framing.rows import RowError
from serial_communication.framing.layout import Value, shortest
from serial_communication.framing.stream import IMPLAUSIBLE, LENGTH

KP = {'setting': 1, 'layout': '<f', 'minimum': 0.0, 'maximum': 10.0, 'unit': '1/s',
      'description': 'proportional gain'}


def row(**changes):
    """The setting of a row with some keys changed; None removes a key."""
    return arduino_settings({'kp': {
        key: value for key, value in {**KP, **changes}.items() if value is not None}})[0]


LINKS = [pytest.param(arduino.encode_raw, arduino.Decoder, id='arduino'),
         pytest.param(arduino.encode_raw, arduino.BoardDecoder, id='to the arduino'),
         pytest.param(lambda type_, data: mcu.encode_raw(type_, 7, data), mcu.Decoder, id='mcu')]


@pytest.mark.parametrize('encode_raw, decoder', LINKS)
def test_a_setting_on_the_wire(encode_raw, decoder):
    kind = row().message
    frame, = decoder(messages=[kind]).feed(b'\0' * (decoder is not mcu.Decoder)
                                           + encode_raw(253, b'\1' + struct.pack('<f', 2.2)))
    assert frame.message == (1, pytest.approx(2.2)) and not frame.cause
    assert str(frame.message) == 'setting number=1 kp=2.2 1/s'
    assert kind(1, 2.2).pack() == b'\1\xcd\xcc\x0c\x40'


@pytest.mark.parametrize('encode_raw, decoder', LINKS)
def test_a_setting_without_a_row_is_no_error_and_one_of_the_wrong_length_is(encode_raw, decoder):
    made = decoder(messages=[row().message])
    frames = [made.feed(encode_raw(253, data))[0] for data in (
        b'\2\7\0', b'\1\0\0\0', b'\1' + struct.pack('<f', math.nan), b'')]
    assert [frame.cause for frame in frames] == ['', LENGTH, IMPLAUSIBLE, LENGTH]
    assert str(frames[0].message) == 'setting number=2 [7 0]'
    assert '4 bytes of data where 5 is right' in frames[1].error


@pytest.mark.parametrize('decoder', [arduino.Decoder, arduino.BoardDecoder])
@pytest.mark.parametrize('value', [math.nan, math.inf])
def test_a_value_that_is_no_number_is_invalid_also_without_check_plausibility(decoder, value):
    made = decoder(check_plausibility=False, messages=[row().message])
    frames = [made.feed(arduino.encode_raw(253, b'\1' + struct.pack('<f', number)))[0]
              for number in (value, 2.0)]
    assert [(frame.cause, frame.message) for frame in frames] == [
        (IMPLAUSIBLE, None), ('', (1, 2.0))]


@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
def test_a_float_has_the_fewest_digits_that_are_this_float32(number):
    short = shortest(number)
    assert struct.pack('<f', short) == struct.pack('<f', number)
    assert len(repr(short)) <= len(repr(number))


@pytest.mark.parametrize('changes, values', [
    ({}, [-0.1, 10.1, 10.000001, math.nan, math.inf, 'text', None, [1.0]]),
    ({'layout': '<B', 'minimum': 3, 'maximum': None}, [2, 256, -1]),
    ({'layout': '<?', 'minimum': None, 'maximum': None}, [2, -1]),
    ({'minimum': None, 'maximum': None}, [1e39, math.inf])])
def test_values_that_are_not_allowed(changes, values):
    for value in values:
        with pytest.raises(ValueError):
            row(**changes).checked(value)


LIMITS = st.floats(*Value('', code='f').range)


@given(LIMITS, LIMITS)
def test_what_a_limit_is_rounded_to_is_allowed(one, other):
    setting = row(minimum=min(one, other), maximum=max(one, other))
    for value in one, other, setting.minimum, setting.maximum, setting.default:
        rounded = setting.checked(value)
        assert setting.checked(rounded) == rounded


@pytest.mark.parametrize('name, changes, key, words', [
    ('kp', {'setting': None}, 'kp/setting', 'is missing'),
    ('kp', {'setting': 256}, 'kp/setting', 'from 0 to 255'),
    ('kp', {'layout': '<ff'}, 'kp/layout', '< and one of'),
    ('kp', {'layout': '<?'}, 'kp/minimum', 'not a key'),
    ('kp', {'layout': '<B', 'maximum': 256}, 'kp/maximum', 'from 0 to 255'),
    ('kp', {'maximum': math.nan}, 'kp/maximum', 'a number from'),
    ('kp', {'minimum': 11}, 'kp/minimum', 'at most the maximum, 10'),
    ('kp', {'unit': 3}, 'kp/unit', 'may be text'),
    ('kp', {'type': 32}, 'kp/type', 'not a key'),
    ('2kp', {}, '2kp', 'name of letters')])
def test_every_mistake_in_a_row(name, changes, key, words):
    with pytest.raises(RowError) as caught:
        mcu_settings({name: {k: v for k, v in {**KP, **changes}.items() if v is not None}})
    assert caught.value.key == 'mcu/settings/' + key and words in str(caught.value)


def test_no_two_settings_have_one_number():
    with pytest.raises(RowError, match='already the setting of a'):
        arduino_settings({'a': KP, 'b': KP})
