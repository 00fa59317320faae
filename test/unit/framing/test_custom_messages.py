"""Custom messages: from a row of parameters to bytes and back, and every mistake in a row."""
import math
import struct
import tracemalloc

import pytest

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.boards.bus import wire as bus
from serial_communication.framing.stream import IMPLAUSIBLE, LENGTH
from decoding import errors_of
from board_rows import car_messages as arduino_messages
from board_rows import functions as bus_functions
from board_rows import mcu_messages
from serial_communication.framing.rows import RowError

FORCE = {'type': 32, 'ros_type': 'std_msgs/Float32', 'layout': '<h', 'fields': ['data'],
         'scale': 0.01, 'minimum': 0, 'maximum': 300}
PUMP = {'cmd2': 48, 'srv_type': 'std_srvs/SetBool',
        'request': {'layout': '<?', 'fields': ['data']}}

DRIVE = {'type': 40, 'direction': 'to_board', 'ros_type': 'geometry_msgs/Twist', 'layout': '<hh',
         'fields': ['linear.x', 'angular.z'], 'scale': 0.001}


def one(row, **changes):
    """The message of a row with some keys changed; None removes a key."""
    row = {key: value for key, value in dict(row, **changes).items() if value is not None}
    make = bus_functions if 'cmd2' in changes or 'cmd2' in row else arduino_messages
    return make({'name': row})[0]


def message(layout, fields, **changes):
    return one(FORCE, layout=layout, fields=fields, **dict(
        {'scale': None, 'minimum': None, 'maximum': None}, **changes)).message


def wire(kind, data):
    return arduino.encode_raw(kind.TYPE, data)


def received(kind, data):
    """The message that a decoder makes of a packet with this data, and its errors."""
    decoder = arduino.Decoder(messages=[kind])
    frame, = decoder.feed(wire(kind, data))
    return frame.message, errors_of([frame])


# -- values ---------------------------------------------------------------------------------------


@pytest.mark.parametrize('layout, data, values', [
    ('<bBhH', 'ff ff feff feff', (-1, 255, -2, 65534)),
    ('>bBhH', 'ff ff fffe fffe', (-1, 255, -2, 65534)),
    ('<iIqQ', '00000080 000000ff ffffffffffffff7f ffffffffffffffff',
     (-2**31, 0xff000000, 2**63 - 1, 2**64 - 1)),
    ('>i I', '80000000 00000001', (-2**31, 1)),
    ('<f', '0000c03f', (1.5,)), ('>d', 'bff8000000000000', (-1.5,)), ('<e', '003e', (1.5,)),
    ('<??', '00 05', (False, True)),
    ('<2xB3x', '0000 07 000000', (7,)),
    ('<3B', '01 02 03', (1, 2, 3)),
    ('<5s', '68c3a9 00 78', ('hé',)),
    ('<BH*', '01', (1, ())), ('<BH*', '01 0200 0300', (1, (2, 3))), ('>h*', 'fffe', ((-2,),)),
    ('<Bs', '01', (1, '')), ('<Bs', '01 616263', (1, 'abc')), ('<s', '6100 6263', ('a',)),
    ('<s', 'ff61', ('\ufffda',)),
])
def test_values_of_every_kind(layout, data, values):
    data = bytes.fromhex(data)
    kind = message(layout, [f'f{index}' for index in range(len(values))])
    assert received(kind, data) == (values, {})


def test_scale_and_offset_are_one_number_or_one_for_each_value():
    assert message('<bb', ['a', 'b'], scale=-0.5, offset=[1, -1]).unpack(b'\2\4') == (0.0, -3.0)
    assert message('<bb', ['a', 'b'], scale=[2, 1]).unpack(b'\2\4') == (4, 4)
    assert message('<h*', ['a'], scale=0.5, offset=1).unpack(b'\2\0\4\0') == ((2.0, 3.0),)


def test_an_empty_field_leaves_a_value_out():
    kind = message('<Bh', ['', 'data'])
    got, _ = received(kind, b'\7\1\0')
    assert str(got) == 'name data=1'
    assert kind(99, 5).pack() == b'\0\5\0'


# -- what is refused ------------------------------------------------------------------------------

@pytest.mark.parametrize('layout, data', [
    ('<h', '01'), ('<h', '010000'), ('<BH*', ''), ('<BH*', '0102'), ('<4s', '6162'), ('<', '00')])
def test_a_wrong_length_is_a_length_error(layout, data):
    kind = message(layout, ['a', 'b'][:len(layout.replace('4', '').replace('*', '')) - 1])
    assert received(kind, bytes.fromhex(data)) == (None, {LENGTH: 1})


@pytest.mark.parametrize('limits, raw, plausible', [
    ({'minimum': 0, 'maximum': 3}, 0, True), ({'minimum': 0, 'maximum': 3}, 3, True),
    ({'minimum': 0, 'maximum': 3}, 4, False), ({'minimum': 0}, -1, False),
    ({'minimum': 0}, 32767, True), ({'maximum': -5}, -4, False), ({'maximum': -5}, -5, True)])
def test_a_value_outside_its_limits_is_implausible(limits, raw, plausible):
    kind = message('<h', ['data'], **limits)
    data = raw.to_bytes(2, 'little', signed=True)
    assert received(kind, data)[1] == ({} if plausible else {IMPLAUSIBLE: 1})
    assert bool(kind(raw).implausible()) != plausible
    # A row's limits hold without check_plausibility, which is for built-in messages.
    decoder = arduino.Decoder(check_plausibility=False, messages=[kind])
    frame, = decoder.feed(arduino.encode_raw(kind.TYPE, data))
    assert (not frame.cause) == plausible


@pytest.mark.parametrize('layout, maximum, scale, at, beyond', [
    ('<h', 0.3, 0.1, 3, 4), ('<h', 0.36, 0.1, 3, 4), ('<B', 2.805, 0.011, 255, None),
    ('<I', 4000000129, 1, 4000000129, 4000000130), ('<f', 0.6, 1, 0.6, 0.60001),
    ('<f', 0.7, 0.1, 7, 7.00001), ('<e', 0.6, 1, 0.6, 0.602), ('<B*', 0.3, 0.1, 3, 4)])
def test_a_limit_takes_its_own_value(layout, maximum, scale, at, beyond):
    kind = message(layout, ['data'], maximum=maximum, minimum=-maximum * layout.islower(),
                   scale=scale)
    assert received(kind, struct.pack(layout[:2], at))[1] == {}
    for value in maximum, struct.unpack('<f', struct.pack('<f', maximum))[0]:
        command = kind((value,) if '*' in layout else value)
        assert not command.implausible() or value > maximum + scale
    if beyond:
        assert received(kind, struct.pack(layout[:2], beyond))[1] == {IMPLAUSIBLE: 1}


@pytest.mark.parametrize('layout, invalid, data, text', [
    ('<H', 65535, 'ffff', 'a=none'), ('<H', 65535, 'feff', 'a=65.534'),
    ('>h', -1, 'ffff', 'a=none'), ('<?', 1, '01', 'a=none'), ('<Q', 2**64 - 1, 'ff' * 8, 'a=none'),
    ('<f', -1, '000080bf', 'a=none'), ('<f', math.inf, '0000807f', 'a=none'),
    ('<hs', [-1, ''], 'ffff6f6b', "a=none b='ok'"),
    ('<hh', [-1, ''], 'ffffffff', 'a=none b=-0.001'), ('<Bh', 300, '2c2c01', 'a=0.044 b=none'),
    ('<H*', 65535, '0100ffff', 'a=[0.001 none]')])
def test_a_raw_number_may_mean_no_value(layout, invalid, data, text):
    fields = ['a', 'b'][:len(layout.rstrip('*')) - 1]
    kind = message(layout, fields, invalid=invalid, scale=0.001)
    got, errors = received(kind, bytes.fromhex(data))
    assert str(got) == f'name {text}' and not errors
    assert got.pack() == bytes.fromhex(data), 'a simulated board sends it'


def test_no_value_is_not_implausible_but_nan_is():
    kind = message('<HfB*', ['a', 'b', 'c'], invalid=[65535, -1, 255], minimum=0,
                   maximum=[100, 1.5, 9])
    data = b'\xff\xff' + struct.pack('<f', -1) + b'\5\xff'
    got, errors = received(kind, data)
    assert [math.isnan(number) for number in (got[0], got[1], *got[2])] == [
        True, True, False, True] and not errors
    assert received(kind, b'\xff\xff' + struct.pack('<f', math.nan))[1] == {IMPLAUSIBLE: 1}
    assert received(kind, b'\xfe\xff' + struct.pack('<f', -1))[1] == {IMPLAUSIBLE: 1}


@pytest.mark.parametrize('layout, values', [
    ('<h', (32768,)), ('<B', (-1,)), ('<B', (256,)), ('<f', (1e39,)), ('<B', (float('nan'),)),
    ('<q', (float('inf'),)), ('<3s', ('four',)), ('<s', ('nul\0',)), ('<B*', ((1, 256),)),
    ('<B', ('1',)), ('<s', (1,)), ('<B*', (3,))])
def test_a_value_that_its_place_cannot_hold_is_not_packed(layout, values):
    with pytest.raises(ValueError) as refusal:
        message(layout, ['data'])(*values).pack()
    assert str(refusal.value).startswith('data is ')


def test_custom_mcu_frames():
    custom, = mcu_messages({'line': dict(FORCE, type=0x20)})
    decoder = mcu.Decoder([custom.message])
    frame, = decoder.feed(mcu.encode(custom.message(12.5), 7))
    assert (frame.message, frame.type, frame.number) == ((12.5,), 0x20, 7)
    frames = decoder.feed(mcu.encode_raw(0x20, 8, b'\1') + mcu.encode_raw(0x20, 9, b'\xff\xff'))
    assert [frame.cause for frame in frames] == [LENGTH, IMPLAUSIBLE]


def test_a_custom_function():
    pump = one(PUMP)
    assert pump.make_request((True,)) == bus.Request(bus.FUNCTION, 48, b'\1')
    assert str(pump.make_request((True,))) == 'name data=true'
    assert (pump.timeout, pump.repeatable, pump.reply.size) == (None, False, 0)
    polled, = bus_functions({'level': {
        'cmd2': 49, 'ros_type': 'std_msgs/Float32', 'period': 2, 'timeout': 0.2,
        'reply': {'layout': '<H', 'fields': ['data'], 'scale': 0.1}}})
    assert (polled.repeatable, polled.period, polled.timeout) == (True, 2, 0.2)
    assert polled.reply.unpack(b'\x0a\0') == (1.0,)
    assert polled.make_request(()) == bus.Request(bus.FUNCTION, 49)
    for data, text in (b'\x0a\0', 'level OK data=1'), (b'\x0a', 'OK 0a'):
        assert str(polled.name_reply(bus.Reply(bus.OK, data))) == text


# -- motions --------------------------------------------------------------------------------------

def test_twists_are_motions_by_default_and_other_commands_may_be():
    arm = dict(DRIVE, ros_type='std_msgs/Int16', layout='<h', fields=['data'])
    assert [one(row).motion for row in (
        DRIVE, dict(DRIVE, ros_type='geometry_msgs/TwistStamped'), dict(DRIVE, motion=False), arm,
        dict(arm, motion=True), FORCE)] == [True, True, False, False, True, False]
    assert one(DRIVE, motion=False, layout='<h*', fields=['data']).layout.layout == '<h*'


def test_the_zero_of_a_motion_is_0_by_scale_and_offset_and_raw_0_where_left_out():
    row = one(DRIVE, layout='<BhB?', fields=['', 'linear.x', 'angular.z', 'linear.y'],
              scale=[1, 0.5, 0.1, 1], offset=[7, -1, -12.8, 0])
    assert row.zero.pack() == b'\0\2\0\x80\0'


@pytest.mark.parametrize('given, sent, why', [
    ((0.25, -1.5), (0.25, -1.5), ''), ((0.6000000238418579, 0), (0.6000000238418579, 0), ''),
    ((-0.7, 0.1), (-0.6, 0.1), 'name: linear.x is -0.7, out of range, sent -0.6'),
    ((0.1, 1e9), (0.1, 32.767), 'name: angular.z is 1e+09, out of range, sent 32.767'),
    ((math.nan, 1), (0, 0), 'name: linear.x is nan, sent 0'),
    ((0.1, -math.inf), (0, 0), 'name: angular.z is -inf, sent 0')])
def test_a_motion_is_saturated_and_what_is_not_finite_is_the_zero(given, sent, why):
    row = one(DRIVE, minimum=[-0.6, -math.inf], maximum=[0.6, math.inf])
    values, reason = row.saturated(given)
    assert (tuple(values), reason) == (sent, why)
    row.message(*values).pack()
    assert not row.message(*values).implausible()


# -- mistakes -------------------------------------------------------------------------------------

@pytest.mark.parametrize('row, changes, key, words', [
    (FORCE, {'type': None}, 'type', 'is missing, may be a whole number from 13 to 252'),
    (FORCE, {'type': 12}, 'type', 'is 12 (int), may be'),
    (FORCE, {'type': True}, 'type', 'is True (bool)'),
    (FORCE, {'direction': 'up'}, 'direction', 'may be from_board or to_board'),
    (FORCE, {'ros_type': 'a/b/c'}, 'ros_type', "is 'a/b/c' (str), may be a"),
    (PUMP, {'srv_type': ['std_msgs/Bool']}, 'srv_type', 'may be a'),
    (FORCE, {'layout': 'h'}, 'layout', 'begin with < or >'),
    (FORCE, {'layout': '<h*B'}, 'layout', 'struct'),
    (FORCE, {'layout': '<c'}, 'layout', 'c holds no number'),
    (FORCE, {'layout': '<256xh'}, 'layout', 'it has 258 bytes, there may be 255'),
    (PUMP, {'reply': {'layout': '<1025B', 'fields': ['']}}, 'reply/layout', 'there may be 1024'),
    (FORCE, {'layout': '<hh'}, 'fields', 'a list of 2, one for each value'),
    (FORCE, {'fields': ['vector..x']}, 'fields', 'may be a list with the path'),
    (FORCE, {'fields': ['data[' + '9' * 5000 + ']']}, 'fields', 'may be a list with the path'),
    (FORCE, {'layout': '<hh', 'fields': ['data', 'data']}, 'fields', 'may have data once'),
    (FORCE, {'layout': '<L', 'fields': ['@time']}, 'fields', 'at an I of the layout'),
    (FORCE, {'layout': '<I', 'fields': ['@time'], 'direction': 'to_board'}, 'fields',
     'may have @time at an I of the layout, in a message from the board'),
    (PUMP, {'reply': {'layout': '<I', 'fields': ['@time']}}, 'reply/fields',
     'in a message from the board'),
    (FORCE, {'scale': 0}, 'scale', 'may be a number but 0'),
    (FORCE, {'scale': [1, 2]}, 'scale', 'or a list of 1'),
    (FORCE, {'offset': math.inf}, 'offset', 'may be a number'),
    (FORCE, {'minimum': 200, 'maximum': 100}, 'minimum', 'at most the maximum, 100'),
    (FORCE, {'frame_id': ['x'] * 10**5}, 'frame_id', '… (list), may be text'),
    (FORCE, {'constants': {'a b': 1}}, 'constants', 'may be a group with a value for the path'),
    (FORCE, {'constants': {}, 'direction': 'to_board'}, 'constants', 'is not a key'),
    (FORCE, {'child_frame_id': 'a', 'frame_id': 'a'}, 'child_frame_id', 'needs a frame_id, of ano'),
    (FORCE, {'frame\nid': 'x'}, 'frame\ufffdid', 'is not a key of such a row'),
    (FORCE, {'motion': True}, 'motion', 'is not a key'),
    (DRIVE, {'layout': '<h*', 'fields': ['data']}, 'motion', 'numbers and bools alone'),
    (DRIVE, {'minimum': 0.1}, 'motion', 'has to allow the zero of a motion'),
    (FORCE, {'invalid': 'none'}, 'invalid', "is 'none' (str), may be a number, or an empty"),
    (FORCE, {'invalid': 40000}, 'invalid', 'is 40000 (int), may be a raw number that its'),
    (FORCE, {'layout': '<f', 'invalid': 0.1}, 'invalid', 'its place (f) can hold exactly'),
    (FORCE, {'invalid': -1, 'direction': 'to_board'}, 'invalid', 'is not a key'),
    (PUMP, {'cmd2': 255}, 'cmd2', 'from 0 to 254'),
    (PUMP, {'ros_type': 'std_msgs/Bool'}, '', 'either srv_type or ros_type'),
    (PUMP, {'period': 1}, 'period', 'is not a key'),
    (PUMP, {'timeout': 0}, 'timeout', 'from 0.01 to 600'),
    (PUMP, {'repeatable': 1}, 'repeatable', 'true or false'),
    (PUMP, {'interrupts': True}, 'repeatable', 'has to be true where interrupts is true'),
    (PUMP, {'request': 5}, 'request', 'a group'),
    (PUMP, {'srv_type': None, 'ros_type': 'std_msgs/Bool', 'request': None}, 'period',
     'is missing'),
])
def test_every_mistake_in_a_row_is_reported_in_one_line(row, changes, key, words):
    with pytest.raises(RowError) as mistake:
        one(row, **changes)
    what = 'bus/functions' if 'cmd2' in row else 'arduino/messages'
    assert str(mistake.value).startswith(f'{what}/name/{key}'.rstrip('/') + ' ')
    assert words in str(mistake.value) and '\n' not in str(mistake.value)
    assert len(str(mistake.value)) < 400


@pytest.mark.parametrize('make, entries, key, words', [
    (arduino_messages, {'a': FORCE, 'b': FORCE}, 'b/type', 'is already the type of a'),
    (bus_functions, {'a': PUMP, 'b': PUMP}, 'b/cmd2', 'is already the cmd2 of a'),
    (mcu_messages, {'a': dict(FORCE, type=0x10)}, 'a/type', '0 to 252'),
    (mcu_messages, {'a': dict(FORCE, direction='to_board')}, 'a/direction', 'may be from_board'),
    (mcu_messages, {'a': dict(FORCE, layout='<254xh')}, 'a/layout', '253'),
    (arduino_messages, {'2nd': FORCE}, '2nd', 'letter'),
    (arduino_messages, {'a\n\ud800': FORCE}, 'a\ufffd\ufffd', 'letter'),
    (arduino_messages, {'a': 5}, 'a', 'may be a group of keys'),
    (arduino_messages, [FORCE], '', 'a group of rows')])
def test_mistakes_in_names_and_numbers_are_reported(make, entries, key, words):
    with pytest.raises(RowError) as mistake:
        make(entries)
    assert f'/{key}'.rstrip('/') + ' ' in str(mistake.value)
    assert words in str(mistake.value)


@pytest.mark.parametrize('layout', [
    '<50000000h', '>900000000d', '<50000000x', '<50000000s', '<50000000hs', '<9999999hB*'])
def test_a_layout_too_long_for_a_frame_takes_no_memory(layout):
    """Its size is checked before its values are made: fifty million take minutes and gigabytes."""
    tracemalloc.start()
    try:
        with pytest.raises(RowError, match='bytes, there may be 255'):
            one(FORCE, layout=layout)
        _now, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert most < 10**6
