"""Any valid rows and any values, in both directions: from the bytes of a packet to the fields of a
ROS message that a subscriber gets, and from a published message to the bytes for the board."""
import math
import struct
from io import BytesIO

import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip('rospy')
from sensor_msgs.msg import CameraInfo  # noqa: E402

from serial_communication.boards.arduino import DESCRIPTION, wire  # noqa: E402
from serial_communication.ros.rows import read_rows  # noqa: E402

# CameraInfo has all kinds of fields: integers, fractions, a bool, a text, and both kinds of arrays.
WHOLE = ('height', 'width', 'binning_x', 'binning_y', 'roi.x_offset', 'roi.height')   # uint32
FRACTIONS = tuple(f'{name}[{index}]' for name in 'KP' for index in range(4))          # float64
TRUTHS = ('roi.do_rectify',)

_CODES = 'bBhHiIlLqQefd?'


def encoded(layout, raws):
    """The bytes of these raw numbers and texts.

    `layout` has single characters and a last ``*`` or ``s``, but no counts and no padding.
    """
    data = b''
    for code, raw in zip(layout[1:].replace('*', ''), raws):
        for each in raw if isinstance(raw, list) else [raw]:
            data += each.encode() if code == 's' else struct.pack(layout[0] + code, each)
    return data


def numbers(code):
    """Any number of one of struct's codes."""
    if code == '?':
        return st.booleans()
    bits = 8 * struct.calcsize('<' + code)
    if code in 'efd':
        return st.floats(width=bits, allow_nan=False)
    low = -2 ** (bits - 1) if code.islower() else 0
    return st.one_of(st.sampled_from((low, low + 2 ** bits - 1)),
                     st.integers(low, low + 2 ** bits - 1))


_TEXTS = st.text(st.characters(blacklist_characters='\0', blacklist_categories=('Cs',)),
                 max_size=20)


@st.composite
def layout_and_raws(draw):
    """A valid layout, and raw numbers for it."""
    codes = draw(st.lists(st.sampled_from(_CODES), max_size=6))
    layout, raws = draw(st.sampled_from('<>')) + ''.join(codes), [draw(numbers(c)) for c in codes]
    ending = draw(st.sampled_from(('', '*', 's')))
    if ending == '*':
        code = draw(st.sampled_from(_CODES))
        layout += code + '*'
        raws.append(draw(st.lists(numbers(code), max_size=5)))
    elif ending == 's':
        layout += 's'
        raws.append(draw(_TEXTS))
    return layout, raws


def published_as(ros_type, layout):
    """The class of a message with one value, which is published in the field `data`."""
    row, = read_rows(DESCRIPTION, 'messages', {'own': {
        'type': 32, 'ros_type': f'std_msgs/{ros_type}', 'layout': layout, 'fields': ['data']}})
    return row.row.message


@pytest.mark.parametrize('ros_type, least, most, beyond', [
    ('Bool', 0, 1, []), ('Int8', -128, 127, [-129, 128]), ('UInt8', 0, 255, [-1, 256]),
    ('Int16', -2**15, 2**15 - 1, [-2**15 - 1, 2**15]), ('UInt16', 0, 2**16 - 1, [-1, 2**16]),
    ('Int32', -2**31, 2**31 - 1, [-2**31 - 1, 2**31]), ('UInt32', 0, 2**32 - 1, [-1, 2**32]),
    ('Int64', -2**63, 2**63 - 1, [-2**64, 2**63]), ('UInt64', 0, 2**64 - 1, [-1, 2**64]),
    ('Float32', -3.4e38, 3.4e38, [-7e38, 7e38]), ('Float64', -1e308, 1e308, [])])
def test_a_value_that_its_ros_field_cannot_hold_is_implausible(ros_type, least, most, beyond):
    kind = published_as(ros_type, '<d')
    no_numbers = [math.nan, math.inf, -math.inf]
    holds_them = ros_type.startswith('Float')
    for value in [least, most, (least + most) / 2] + no_numbers * holds_them:
        assert not kind(value).implausible(), value
    for value in beyond + no_numbers * (not holds_them):
        assert kind(value).implausible().startswith(f'data is {value:.6g}, out of range (')


def test_an_array_with_a_number_that_its_field_cannot_hold_is_implausible():
    kind = published_as('UInt8MultiArray', '<h*')
    assert not kind((0, 255)).implausible()
    assert kind((0, 256)).implausible().startswith('data is 256, out of range (')
    assert published_as('UInt8', '<B')(255).implausible() == ''


@st.composite
def row_and_raws(draw):
    """A valid row for a CameraInfo, and raw numbers for it."""
    layout, raws = draw(layout_and_raws())
    paths = draw(st.permutations(WHOLE + FRACTIONS + TRUTHS))[:len(raws)]
    if layout[-1] in '*s':
        paths[-1] = 'D' if layout.endswith('*') else 'distortion_model'
    scale, offset = (draw(st.one_of(st.sampled_from(some), st.lists(
        st.sampled_from(some), min_size=len(raws), max_size=len(raws)))) for some in (
            (1, 1, 1, 1.0, 0.5, -2, 0.01), (0, 0, 0.0, 7, -0.25)))
    return dict(ros_type='sensor_msgs/CameraInfo', layout=layout, fields=paths, scale=scale,
                offset=offset), raws


def expected_of(row, raws):
    """The expected value of each field; None for a value that is implausible."""
    wanted = []
    scales, offsets = (row[key] if isinstance(row[key], list) else [row[key]] * len(raws)
                       for key in ('scale', 'offset'))
    for path, raw, scale, offset in zip(row['fields'], raws, scales, offsets):
        if isinstance(raw, str):
            wanted.append(raw)
            continue
        values = [each * scale + offset for each in
                  (raw if isinstance(raw, list) else [raw])]
        if path in TRUTHS:
            if not all(math.isfinite(value) for value in values):
                return None
            values = [value != 0 for value in values]
        elif path in WHOLE:
            if not all(math.isfinite(value) and 0 <= round(value) < 2 ** 32 for value in values):
                return None
            values = [round(value) for value in values]
        else:
            values = [float(value) for value in values]
        wanted.append(values if isinstance(raw, list) else values[0])
    return wanted


def field(message, path):
    """The value at a path, evaluated by Python."""
    value = eval('message.' + path, {'message': message})   # a path of this file
    return list(value) if isinstance(value, tuple) else value


def delivered(message):
    """The message that a subscriber gets."""
    buffer = BytesIO()
    message.serialize(buffer)
    return CameraInfo().deserialize(buffer.getvalue())


@given(st.lists(row_and_raws(), min_size=1, max_size=6))
def test_any_values_of_any_rows_are_published_and_sent_back_unchanged(cases):
    entries = {}
    for index, (row, _) in enumerate(cases):
        entries[f'from{index}'] = dict(row, type=20 + index)
        entries[f'to{index}'] = dict(row, type=120 + index, direction='to_board')
    rows = {row.row.name: row for row in read_rows(DESCRIPTION, 'messages', entries)}
    decoder = wire.Decoder(messages=[
        rows[f'from{index}'].row.message for index in range(len(cases))])
    for index, (row, raws) in enumerate(cases):
        data = encoded(row['layout'], raws)
        there, back = rows[f'from{index}'], rows[f'to{index}']
        frame, = decoder.feed(wire.encode_raw(20 + index, data))
        wanted = expected_of(row, raws)
        if wanted is None:
            assert (frame.message, frame.cause) == (None, 'implausible')
            continue
        assert type(frame.message) is there.row.message and not frame.cause
        str(frame.message)
        message = delivered(there.fields.fill(there.fields.new(), frame.message))
        assert [field(message, path) for path in row['fields']] == wanted
        is_exact = (row['scale'], row['offset']) == (1, 0) and lossless(row, raws)
        try:
            packed = back.row.message(*back.fields.read(message)).pack()
        except ValueError:
            # Rounding and scaling may exceed the raw number's range, but only by one step.
            assert not is_exact
            continue
        assert not is_exact or packed == data


def lossless(row, raws):
    """Whether each value is unchanged after conversion to its field and back."""
    for path, raw in zip(row['fields'], raws):
        for each in raw if isinstance(raw, list) else [raw]:
            if isinstance(each, str):
                continue
            if path in TRUTHS and each not in (0, 1):
                return False
            if path in WHOLE and each != round(each):
                return False
            if each == 0 and math.copysign(1, each) < 0 or float(each) != each:
                return False
    return True
