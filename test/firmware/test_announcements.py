"""What the sketches announce: valid rows, all of which reach the bridge."""
import os
import re

import pytest
from by_definition import ANNOUNCEMENT
from board_rows import car_messages, car_settings, functions, mcu_messages, mcu_settings

from compilers import run
from emulated_board import FIRMWARE
from packets import HEARTBEAT, OK, UNSUPPORTED, function, request
from serial_communication.framing.announcement import Assembly, Chunk, read_announcement


def text_of(build, image):
    """The announcement in an image."""
    with open(os.path.join(build, image), 'rb') as file:
        return re.search(rb'firmware: [^\0]*', file.read()).group()


def rows_of(text):
    """Messages or functions, and settings, of an announcement, as the bridge reads them."""
    announced = read_announcement(text)
    assert announced.problems == [] and announced.firmware
    assert len(announced.rows) == text.count(b'\n') - 1
    settings = {name: row for name, row in announced.rows.items() if 'setting' in row}
    return {name: row for name, row in announced.rows.items() if 'setting' not in row}, settings


def assembled(chunks):
    assembly = Assembly()
    text, = {text for text in map(assembly.add, map(Chunk.unpack, chunks)) if text}
    return text


@pytest.mark.parametrize('image, read_rows, read_settings', [
    *((image, car_messages, car_settings) for image in (
        'nano_car', 'nano_car_custom', 'DiffDrive', 'Tuning', 'Hello', 'sketches/Button',
        'sketches/Buzzer', 'sketches/NeoPixel', 'sketches/Potentiometer', 'sketches/ServoArm',
        'sketches/Sonar')),
    *((image, mcu_messages, mcu_settings) for image in ('range_imu', 'Sensor')),
    *((image, functions, len) for image in ('ctrl_board_custom', 'Slave'))])
def test_rows_are_valid(firmware_build, image, read_rows, read_settings):
    if image.startswith('sketches/'):
        status, output = run(['make', '-C', FIRMWARE, 'BUILD=' + firmware_build,
                              f'SKETCH=PacketLink/examples/{image[9:]}',
                              'LIBRARIES=../test/firmware/stubs/neopixel'])
        assert status == 0, output
    rows, settings = rows_of(text_of(firmware_build, image + '.elf'))
    assert len(read_rows(rows)) == len(rows)
    assert all(row.unit and row.description for row in read_settings(settings) or ())


@pytest.mark.parametrize('world, image', [
    ('car', 'nano_car_custom.elf'), ('diff', 'DiffDrive.elf'), ('range', 'range_imu.elf'),
    ('range', 'Sensor.elf')])
def test_a_board_sends_its_announcement_by_itself(copy_of, firmware_build, world, image):
    board = copy_of(world, image)
    board.beat = HEARTBEAT * (world != 'range')
    board.until(lambda: board.seen(ANNOUNCEMENT), 1)
    count = board.seen(ANNOUNCEMENT)[0][1]
    board.until(lambda: len(board.seen(ANNOUNCEMENT)) >= count, 1 + 0.11 * count)
    assert assembled(board.seen(ANNOUNCEMENT)) == text_of(firmware_build, image)


def test_a_bus_board_is_asked_for_its_announcement(copy_of, firmware_build):
    bus = copy_of('ctrl', 'ctrl_board_custom.elf')
    assert bus.call(request(0)) == b'\0'
    chunks = []
    while not chunks or len(chunks) < chunks[0][1]:
        reply = bus.call(function(ANNOUNCEMENT, len(chunks)))
        assert reply[:1] == OK
        chunks.append(reply[1:])
    assert assembled(chunks) == text_of(firmware_build, 'ctrl_board_custom.elf')
    assert bus.call(function(ANNOUNCEMENT, len(chunks))) == UNSUPPORTED
