"""Any valid rows and any values, in both directions: from a board over a real tty to the fields of
a ROS message that a subscriber gets, and from a published message to the bytes for the board."""
import logging
import math
import os
import pty
import threading
import tty
from collections import deque
from functools import partial
from io import BytesIO

import pytest
import waiting
from hypothesis import given, settings
from hypothesis import strategies as st
from custom_rows import encoded, layout_and_raws

pytest.importorskip('rospy')
from sensor_msgs.msg import CameraInfo  # noqa: E402

from serial_communication.boards.arduino import DESCRIPTION  # noqa: E402
from serial_communication.boards.arduino.link import ArduinoLink  # noqa: E402
from serial_communication.link.link import Refused  # noqa: E402
from serial_communication.framing import cobs  # noqa: E402
from serial_communication.ros.custom_topics import message_rows  # noqa: E402
from serial_communication.ros.parameters import check  # noqa: E402
from serial_communication.transport.port import Port  # noqa: E402

PATIENCE = 10.0     # s; only a test that fails waits as long
until = partial(waiting.until, seconds=PATIENCE, every=0.001)

# CameraInfo has all kinds of fields: integers, fractions, a bool, a text, and both kinds of arrays.
WHOLE = ('height', 'width', 'binning_x', 'binning_y', 'roi.x_offset', 'roi.height')   # uint32
FRACTIONS = tuple(f'{name}[{index}]' for name in 'KP' for index in range(4))          # float64
TRUTHS = ('roi.do_rectify',)


def published_as(ros_type, layout):
    """The class of a message with one value, which is published in the field `data`."""
    row, = message_rows(DESCRIPTION, {'own': {'type': 32, 'ros_type': f'std_msgs/{ros_type}',
                                              'layout': layout, 'fields': ['data']}})
    return row.kind


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
        assert kind(value).implausible() == (f'data is {value:.6g}, which its ROS field '
                                             'cannot hold')


def test_an_array_with_a_number_that_its_field_cannot_hold_is_implausible():
    kind = published_as('UInt8MultiArray', '<h*')
    assert not kind((0, 255)).implausible()
    assert kind((0, 256)).implausible().startswith('data is 256, which its ROS field')
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


class Stage:
    """A link on a real tty, whose other end this process has."""

    def __init__(self, rows):
        self.near, slave = pty.openpty()
        tty.setraw(slave)
        self.got = deque()
        self.link = ArduinoLink(
            Port(os.ttyname(slave), 115200), messages=[
                row.kind for row in rows if not row.custom.is_command],
            on_message=lambda message, stamp: self.got.append(message),
            logger=logging.getLogger('fuzz'))
        self._slave = slave
        self._packets = b''
        self._reader = threading.Thread(target=self._read, name='far end', daemon=True)
        self._ended = False
        self._reader.start()
        self.link.start()
        until(lambda: b'\x02\x0b' in self._packets, 'a heartbeat')

    def _read(self):
        while not self._ended:
            try:
                self._packets += os.read(self.near, 4096)
            except OSError:
                return

    def sent(self, type_):
        """Wait for a packet of a type; return the data of the first."""
        decoded = [cobs.decode_or_none(each) for each in self._packets.split(b'\0')[:-1] if each]
        return [each[1:] for each in decoded if each[0] == type_]

    def close(self):
        self.link.stop()
        self.link.join()
        self._ended = True
        os.close(self._slave)
        self._reader.join(PATIENCE)
        os.close(self.near)


@settings(max_examples=max(20, settings().max_examples // 2))
@given(st.lists(row_and_raws(), min_size=1, max_size=6))
def test_any_values_of_any_rows_are_published_and_sent_back_unchanged(cases):
    entries = {}
    for index, (row, _) in enumerate(cases):
        entries[f'from{index}'] = dict(row, type=20 + index)
        entries[f'to{index}'] = dict(row, type=120 + index, direction='to_board')
    checked, _ = check({'arduino': {'messages': entries}}, '/node')
    rows = {row.custom.name: row for row in checked['arduino/messages']}
    stage = Stage(rows.values())
    try:
        for index, (row, raws) in enumerate(cases):
            data = encoded(row['layout'], raws)
            there = rows[f'from{index}']
            counted = dict(stage.link.decoder.errors)
            os.write(stage.near, b'\0' + cobs.encode(bytes((20 + index,)) + data) + b'\0')
            until(lambda counted=counted: stage.got or stage.link.decoder.errors != counted,
                  'the packet is taken in')
            wanted = expected_of(row, raws)
            if wanted is None:
                counted['implausible'] += 1
                assert stage.link.decoder.errors == counted and not stage.got
                continue
            values = stage.got.popleft()
            assert stage.link.decoder.errors == counted and type(values) is there.kind
            message = delivered(there.fields.fill(there.fields.new(), values))
            assert [field(message, path) for path in row['fields']] == wanted
            check_way_back(stage, rows[f'to{index}'], row, raws, message, data)
    finally:
        stage.close()


def check_way_back(stage, back, row, raws, message, data):
    """Publish the received message to the board; the bytes are the same, unless rounded."""
    try:
        stage.link.command(back.kind(*back.fields.read(message)))
    except Refused:
        # Rounding and scaling may exceed the raw number's range, but only by one step.
        assert (row['scale'], row['offset']) != (1, 0) or not lossless(row, raws)
        return
    until(lambda: stage.sent(back.kind.TYPE), 'the command')
    if (row['scale'], row['offset']) == (1, 0) and lossless(row, raws):
        assert stage.sent(back.kind.TYPE) == [data]


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
