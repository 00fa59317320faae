"""Whose frames a stream of bytes has: each board's are recognised, and nothing else is."""
import random
from functools import partial

import pytest

from serial_communication.boards import BOARDS, description
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.mcu import wire as mcu
from serial_communication.framing.recognition import Recognition

CHOICE = random.Random(22)
STREAMS = {
    'arduino': b''.join(
        arduino.encode(arduino.Ticks(at % 90)) + arduino.encode(arduino.SteeringAngle(at))
        for at in range(1000)),
    'mcu': b''.join(mcu.encode(mcu.SensorStatus(40 + at, 2 * at, at / 3, 1.0, -2.0), at % 256)
                    for at in range(1000)),
    'bus': b''.join(bus.encode_reply(bus.Reply(bus.OK, bytes((at % 256, at // 256, 7, 8, 9, 10))))
                    for at in range(1000)),
}


def recognition():
    return Recognition({name: partial(description(name).decoder, False, {}) for name in BOARDS})


def fed(data, piece=100):
    one = recognition()
    for at in range(0, len(data), piece):
        one.feed(data[at:at + piece])
    return one


@pytest.mark.parametrize('name', sorted(STREAMS))
@pytest.mark.parametrize('piece', [1, 7, 4096])
def test_a_board_is_recognised_in_any_pieces_from_any_byte_on(name, piece):
    for start in 0, 1, 5:
        assert fed(STREAMS[name][start:start + 200], piece).name == name
    assert fed(STREAMS[name], piece).name == name


def damaged(data, share):
    return bytes(CHOICE.randrange(256) if CHOICE.random() < share else byte for byte in data)


@pytest.mark.parametrize('name', sorted(STREAMS))
def test_a_board_on_a_noisy_line_is_recognised(name):
    assert fed(damaged(STREAMS[name], 0.02)).name == name


def half_speed(data):
    """About what a UART reads at twice the baud rate: each bit twice."""
    bits = ''.join('0' + format(byte, '08b')[::-1] + '1' for byte in data)
    bits = ''.join(bit * 2 for bit in bits)
    return bytes(int(bits[at + 1:at + 9][::-1], 2) for at in range(0, len(bits) - 9, 10))


@pytest.mark.parametrize('data', [
    b'', bytes(9000), b'\xff' * 9000, CHOICE.getrandbits(80000).to_bytes(10000, 'big'),
    b'I (23) boot: ESP-IDF v4.4\r\n' * 300, damaged(STREAMS['mcu'], 0.3),
    *(half_speed(STREAMS[name]) for name in sorted(STREAMS))])
def test_other_bytes_are_nobodys(data):
    assert fed(data).name == ''
    one = fed(data)
    one.finish()
    assert one.name == ''


def test_a_few_frames_are_not_enough():
    one = fed(STREAMS['arduino'][:len(arduino.encode(arduino.Ticks(0)))])
    one.finish()
    assert one.name == ''


def test_the_board_that_follows_another_one_is_recognised():
    one = fed(STREAMS['mcu'])
    for at in range(0, 9000, 100):
        one.feed(STREAMS['arduino'][at:at + 100])
    assert one.name == 'arduino'
    for _ in range(100):
        one.feed(b'\xff' * 100)
    assert one.name == ''


def test_an_end_counts_a_frame_that_waited_for_more():
    """The announced length of a false start covers the frames behind it."""
    frames = b''.join(mcu.encode(mcu.SensorStatus(4, 5, 6.0, 7.0, 8.0), seq) for seq in range(5))
    one = fed(bytes((mcu.STX, 200)) + frames)
    assert one.name == ''
    one.finish()
    assert one.name == 'mcu'
