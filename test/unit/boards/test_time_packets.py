"""The board's time on the wire: which packets TIME is for, and rows that bring their own."""
import pytest

from board_rows import car_messages as arduino_messages
from board_rows import car_settings as arduino_settings
from board_rows import mcu_messages
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.mcu import wire as mcu
from serial_communication.framing.stream import IMPLAUSIBLE, LENGTH, UNKNOWN

TICKS = arduino.encode(arduino.Ticks(1))
ADC = mcu.AdcStatus(1, 2, 3, 4, 5, 6)
STATUS = mcu.SensorStatus(1, 2, 3.0, 4.0, 5.0)
ROW = {'type': 32, 'ros_type': 'std_msgs/Header', 'layout': '<hI', 'fields': ['seq', '@time'],
       'scale': 0.5, 'minimum': 0, 'maximum': 100, 'invalid': 7}


def time(ticks, count):
    return arduino.encode(arduino.Time(ticks, count))


def ticks_of(wire, **options):
    """The board's times of all packets in these bytes of the model car."""
    return [frame.ticks for frame in arduino.Decoder(**options).feed(wire)]


def test_time_on_the_wire():
    assert TICKS == bytes((3, 8, 1, 0))
    assert time(0x01020304, 16) == bytes((7, 254, 4, 3, 2, 1, 16, 0))
    assert mcu.encode(mcu.Time(0x01020304), 9) == bytes(
        (2, 6, 0xFE, 9, 4, 3, 2, 1, 0xFE ^ 9 ^ 4 ^ 3 ^ 2 ^ 1, 3))


@pytest.mark.parametrize('count', [1, 2, 16])
def test_time_is_for_the_next_packets_and_itself(count):
    wire = TICKS + time(5000, count) + TICKS * 20
    assert ticks_of(wire) == [None, 5000, *[5000] * count, *[None] * (20 - count)]


def test_another_time_ends_the_reach_of_the_first():
    assert ticks_of(time(1, 16) + TICKS + time(2, 1) + TICKS * 2) == [1, 1, 2, 2, None]


@pytest.mark.parametrize('packet', [
    *[arduino.encode(arduino.LOGS[severity]('text')) for severity in range(4)],
    arduino.encode_raw(255, b'\0\1\0\0text'), arduino.encode_raw(253, b'\1\2')])
def test_log_text_announcements_and_settings_are_not_counted(packet):
    assert ticks_of(time(9, 2) + (packet + TICKS) * 3) == [9, None, 9, None, 9, None, None]


@pytest.mark.parametrize('damage', [
    arduino.encode_raw(200, b'unknown'), arduino.encode_raw(8, b'too long'), b'\x09\x02\0', b'\1\0',
    arduino.encode_raw(10, b'\0\0\xc0\x7f'), arduino.encode_raw(1, b'\xff' * 20),
    b'\1' * 400 + b'\0', arduino.encode_raw(253, b''),
    arduino.encode_raw(254, b'\0\0\0\0'), time(9, 0), time(9, 17)])
def test_damage_ends_the_reach(damage):
    wire = time(9, 16) + TICKS + damage + TICKS
    whole = arduino.Decoder().feed(wire)
    assert [frame.ticks for frame in whole] == [9, 9, None, None] and whole[2].cause
    decoder = arduino.Decoder()
    parts = [frame for byte in wire for frame in decoder.feed(bytes((byte,)))]
    assert [frame.ticks for frame in parts] == [9, 9, None, None]


def test_a_setting_that_has_swallowed_a_counted_packet_ends_the_reach():
    """One byte on the wire was changed: the end of the setting's packet."""
    kind = arduino_settings({'kp': {'setting': 1, 'layout': '<f'}})[0].message
    for end in range(1, 256):
        wire = time(9, 1) + arduino.encode(kind(1, 2.0))[:-1] + bytes((end,)) + TICKS + TICKS
        frames = arduino.Decoder(messages=[kind]).feed(wire)
        assert frames[-2].cause and frames[-1].raw == TICKS and frames[-1].ticks is None


@pytest.mark.parametrize('end', ['reset', 'give_up'])
def test_a_reconnect_or_an_incomplete_packet_ends_the_reach(end):
    decoder = arduino.Decoder()
    decoder.feed(time(9, 16) + b'\x05\1')
    getattr(decoder, end)()
    assert [frame.ticks for frame in decoder.feed(TICKS)] == [None]


def test_an_mcu_time_is_for_the_frame_with_the_next_seq_and_no_other():
    decoder = mcu.Decoder()

    def ticks(*frames):
        return [frame.ticks for frame in decoder.feed(
            b''.join(mcu.encode(message, seq) for message, seq in frames))]

    assert ticks((mcu.Time(7), 255), (STATUS, 0), (ADC, 1)) == [7, 7, None]
    assert ticks((mcu.Time(8), 2), (STATUS, 4), (ADC, 3)) == [8, None, None]
    assert ticks((mcu.Time(8), 5), (mcu.Time(9), 6), (STATUS, 7), (ADC, 7)) == [8, 9, 9, None]
    assert ticks((mcu.Time(1), 8)) == [1]
    decoder.reset()
    assert ticks((STATUS, 9)) == [None]


@pytest.mark.parametrize('type_, data, cause', [
    (0x77, b'unknown', UNKNOWN), (32, b'\5', LENGTH), (32, b'\xff\x7f\0\0\0\0', IMPLAUSIBLE)])
def test_an_mcu_time_is_for_no_frame_behind_an_unknown_or_invalid_one_with_the_next_seq(
        type_, data, cause):
    row, = mcu_messages({'force': ROW})
    wire = mcu.encode(mcu.Time(7), 5) + b''.join(
        mcu.encode_raw(type_, seq % 256, data) for seq in range(6, 6 + 256))
    frames = mcu.Decoder(messages=[row.message]).feed(wire + mcu.encode(ADC, 6))
    assert frames[0].ticks == 7 and frames[-1].message == ADC
    assert {(frame.message, frame.cause) for frame in frames[1:-1]} == {(None, cause)}
    assert [frame.ticks for frame in frames[1:]] == [None] * 257


def test_an_mcu_frame_behind_noise_has_the_time_of_its_seq():
    wire = mcu.encode(mcu.Time(7), 1) + b'noise' + mcu.encode(STATUS, 2)
    assert [frame.ticks for frame in mcu.Decoder().feed(wire) if not frame.cause] == [7, 7]


@pytest.mark.parametrize('read, wire, encode_raw', [
    (arduino_messages, arduino, lambda data: arduino.encode_raw(32, data)),
    (mcu_messages, mcu, lambda data: mcu.encode_raw(32, 1, data))])
def test_a_row_with_the_boards_time_uses_no_scale_no_limit_and_no_invalid_for_it(
        read, wire, encode_raw):
    row, = read({'force': ROW})
    decoder = wire.Decoder(messages=[row.message])
    frame, other = decoder.feed(encode_raw(b'\4\0\7\0\0\0') + encode_raw(b'\5\0\xff\xff\xff\xff'))
    assert (frame.message, frame.ticks) == ((2.0, 7), 7)
    assert (other.message, other.ticks) == ((2.5, 2 ** 32 - 1), 2 ** 32 - 1)
    assert row.message(2.5, 2 ** 32 - 1).pack() == b'\5\0\xff\xff\xff\xff'


def test_a_row_prefers_its_own_time_and_is_counted():
    row, = arduino_messages({'force': ROW})
    own = arduino.encode_raw(32, b'\4\0\7\0\0\0')
    assert ticks_of(time(9, 2) + own + TICKS * 2, messages=[row.message]) == [9, 7, 9, None]


def test_bytes_behind_a_frame_are_those_of_its_own_read_inside_a_false_frame():
    decoder, wire = mcu.Decoder(), mcu.encode(STATUS, 1)
    assert decoder.feed(bytes((2, 200))) == []
    assert decoder.feed(wire + wire[:3], 'first') == []
    assert decoder.feed(wire[3:] + b'12345', 'second') == []
    frames = [frame for frame in decoder.give_up() if not frame.cause]
    assert [(frame.stamp, frame.behind) for frame in frames] == [('first', 3), ('second', 5)]
