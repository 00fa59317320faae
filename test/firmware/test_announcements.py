"""A sketch that announces its rows: when its chunks are sent, and that nothing waits for them."""
import os
import re

import pytest

from board_ends import OK, car_end, error, master_end
from emulated_board import FIRMWARE
from board_rows import car_messages, car_settings, functions, mcu_messages
from serial_communication.boards.arduino import wire as arduino
from serial_communication.simulation.arguments import read_parameters
from serial_communication.boards.mcu import wire as mcu
from serial_communication.framing.announcement import (TYPE, Assembly, Chunk,
                                                       read_announcement)

EXAMPLES = read_parameters(os.path.join(os.path.dirname(FIRMWARE), 'config',
                                        'custom_messages.yaml'))


def chunks_of(output, decoder):
    """The (ms, chunk) of the chunks in the lines that the port prints."""
    found = [(int(line.split()[0]), frame.message) for line in output.splitlines()
             for frame in decoder.feed(bytes.fromhex(line.split()[1]))]
    return [(ms, message) for ms, message in found if isinstance(message, Chunk)]


def assembled(chunks):
    """The text of these chunks, none of which is missing."""
    assembly = Assembly()
    assert [chunk.index for chunk in chunks] == [
        index % chunks[0].count for index in range(len(chunks))]
    return [text for text in map(assembly.add, chunks) if text]


def quick(chunks):
    """How many of them are sent every 100 ms: each twice, and at least 3 s."""
    return max(30, 2 * chunks[0][1].count)


def test_chunks_are_sent_ten_times_a_second_until_all_have_gone_twice(library_case):
    chunks = chunks_of(library_case('chunks_beside_the_packets_of_the_car'), arduino.Decoder())
    assert assembled([chunk for _, chunk in chunks]) == [library_case('print_rows').encode()]
    times = [ms for ms, _ in chunks]
    gaps = [(ms, ms - last) for last, ms in zip(times, times[1:])]
    # A chunk waits for an empty buffer, so it may be a few ms late. At 7 s heartbeats return.
    often = quick(chunks)
    assert often == 48
    end = 100 * often + 100
    assert [gap for ms, gap in gaps if 100 <= gap <= 110 and ms < end] == [100] * (often - 1), gaps
    assert all(1000 <= gap <= 1010 for ms, gap in gaps if end < ms < 7000), gaps
    assert all(100 <= gap <= 110 for ms, gap in gaps if ms > 7010), gaps
    assert len([ms for ms in times if ms >= 7000]) == 20


def test_a_sensor_board_sends_its_chunks_between_its_frames(library_case):
    output = library_case('chunks_between_the_frames_of_a_sensor_board')
    chunks = [chunk for _, chunk in chunks_of(output, mcu.Decoder())]
    assert assembled(chunks) == [library_case('print_rows').encode()] and len(chunks) == 30


def test_without_an_announcement_no_byte_is_sent(library_case):
    assert library_case('no_announcement') == ''


# The reference sketches, on the emulated chip


def rows_in(text):
    """The rows of an announcement, none of which is left out."""
    announcement = read_announcement(text)
    assert announcement.problems == []
    return announcement.firmware, announcement.rows


def test_the_car_announces_the_example(firmware_build):
    with car_end(firmware_build, image='nano_car_custom.elf') as car:
        car.board.wait_until(lambda: car.read(TYPE), 1)
        count = Chunk.unpack(car.read(TYPE)[0]).count
        car.board.wait_until(lambda: len(car.read(TYPE)) >= count, 1 + count / 10)
        text, = set(assembled([Chunk.unpack(data) for data in car.read(TYPE)]))
        firmware, rows = rows_in(text)
        assert firmware == 'nano_car 1.3.0'
        settings = {name: rows.pop(name) for name, row in list(rows.items()) if 'setting' in row}
        assert [row.name for row in car_settings(settings)] == [
            'imu_rate', 'motor_ramp', 'steering_range']
        named = {name: EXAMPLES['arduino']['messages'][name] for name in ('force', 'gripper')}
        assert car_messages(rows) == car_messages(named)


def test_the_control_board_announces_the_example(firmware_build):
    with master_end(firmware_build, image='ctrl_board_custom.elf') as master:
        master.sync()
        assembly, index, text = Assembly(), 0, None
        while text is None:
            reply = master.function(TYPE, bytes([index]))
            assert reply[:1] == OK
            text = assembly.add(Chunk.unpack(reply[1:]))
            index += 1
        assert master.function(TYPE, bytes([index])) == error(0x8000)
        assert master.function(TYPE) == error(0x8000)
        firmware, rows = rows_in(text)
        assert firmware == 'ctrl_board 1.3.0'
        named = {name: EXAMPLES['bus']['functions'][name] for name in ('pump', 'halt', 'tank')}
        assert functions(rows) == functions(named)


def test_without_custom_messages_the_bus_board_announces_nothing(bus):
    assert bus.function(TYPE, b'\0') == error(0x8000)


@pytest.mark.parametrize('example', [
    'Button', 'Buzzer', 'Hello', 'HelloESP32', 'NeoPixel', 'Potentiometer', 'Sensor',
    'ServoArm', 'Slave', 'Sonar'])
def test_the_rows_of_the_examples_are_valid(example):
    path = os.path.join(FIRMWARE, 'protocol', 'examples', example, example + '.ino')
    with open(path, encoding='utf-8') as file:
        literal = re.search(r'kRows\[\] PROGMEM =\n((?: +".*"\n?)+);', file.read()).group(1)
    text = ''.join(re.findall(r'"(.*)"', literal)).replace('\\n', '\n')
    firmware, rows = rows_in(text.encode())
    assert firmware.endswith(' 1.0')
    read = {'Sensor': mcu_messages, 'Slave': functions}.get(example, car_messages)
    assert len(read(rows)) == text.count('\n') - 1
