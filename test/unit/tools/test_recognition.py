"""Whose frames a stream of bytes has: each board's are recognised, and nothing else is."""
import random

import pytest

from serial_communication.boards import BOARDS
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.mcu import wire as mcu
from serial_communication.tools.ports.listening import recognised
from wire_lines import settings

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


def board_of(data):
    return recognised(map(settings, BOARDS), data)


@pytest.mark.parametrize('name', sorted(STREAMS))
def test_a_board_is_recognised_from_any_byte_on(name):
    for start in 0, 1, 5:
        assert board_of(STREAMS[name][start:start + 200]) == name
    assert board_of(STREAMS[name]) == name


def damaged(data, share):
    return bytes(CHOICE.randrange(256) if CHOICE.random() < share else byte for byte in data)


@pytest.mark.parametrize('name', sorted(STREAMS))
def test_a_board_on_a_noisy_line_is_recognised(name):
    assert board_of(damaged(STREAMS[name], 0.02)) == name


@pytest.mark.parametrize('data', [
    b'', bytes(9000), b'\xff' * 9000, CHOICE.getrandbits(80000).to_bytes(10000, 'big'),
    b'I (23) boot: ESP-IDF v4.4\r\n' * 300, damaged(STREAMS['mcu'], 0.3),
    STREAMS['arduino'][:len(arduino.encode(arduino.Ticks(0)))]])
def test_other_bytes_are_nobodys(data):
    assert board_of(data) == ''
