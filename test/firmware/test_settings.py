"""Settings of a sketch: what it answers, and when it reports them."""
import ast
import os
import re
import struct

import pytest
from by_definition import ANNOUNCEMENT, arduino_at, mcu_at, mcu_frame
from board_rows import car_settings
from waiting import again_if_stalled

from board_ends import (
    MCU_SETTING, SETTING, SPEED, car_end, packet)
from compilers import ON_THE_AVR, PROTOCOL, run
from emulated_board import FIRMWARE
from serial_communication.framing.announcement import read_announcement
from wheel import hold, set_to, target

NUMBERS = [1, 2, 3, 4, 5, 200]      # those of library_cases.cpp, in the order of their table


def packets_of(output):
    """The (ms, packet) of the lines that the port prints."""
    return [(int(line.split()[0]), arduino_at(bytes.fromhex(line.split()[1]), 0))
            for line in output.splitlines()]


def reports(packets):
    return [(ms, packet.data[0]) for ms, packet in packets if packet.type == SETTING]


def test_the_rows_of_a_list_have_what_the_sketch_has(library_case):
    announcement = read_announcement(library_case('print_setting_rows').encode())
    assert announcement.problems == []
    read = {row.name: (row.number, row.code, row.minimum, row.maximum, row.unit, row.description)
            for row in car_settings(announcement.rows)}
    assert read == {
        'gain': (1, 'f', 0, 10, '1/s', 'a gain'), 'period': (2, 'H', 5, 60000, 'ms', 'a period'),
        'inverted': (3, '?', 0, 1, '', 'whether it turns the other way'),
        'trim': (4, 'b', -100, 100, '', ''), 'mask': (200, 'I', 7, 2 ** 32 - 1, '', ''),
        'position': (5, 'i', 1 - 2 ** 31, 16777217, '', '')}


@pytest.mark.parametrize('sketch', [
    'nano_car/nano_car', 'range_imu/range_imu', 'protocol/examples/DiffDrive/DiffDrive',
    'protocol/examples/Tuning/Tuning'])
def test_the_rows_of_a_sketch_are_valid(sketch, tmp_path):
    """By the preprocessor, which makes one text of its rows."""
    source = os.path.join(FIRMWARE, sketch + '.ino')
    status, output = run([*ON_THE_AVR, '-std=gnu++11', '-E', '-P', '-x', 'c++', '-I', PROTOCOL,
                          '-include', 'Arduino.h', source])
    assert status == 0, output
    literal = re.search(r'kRows\[\].*?= *(.*?);\n', output, re.S).group(1)
    announcement = read_announcement(ast.literal_eval(f'({literal})').encode())
    assert announcement.problems == [] and announcement.firmware
    settings = {name: row for name, row in announcement.rows.items() if 'setting' in row}
    read = car_settings(settings)
    assert len(read) >= 2 and all(row.unit and row.description for row in read)


def test_settings_are_reported_after_the_start_and_then_in_turn(library_case):
    found = reports(packets_of(library_case('settings_alone_in_packets')))
    assert found == list(enumerate(NUMBERS)) + [
        (1000 * (index + 1), NUMBERS[index % 6]) for index in range(19)]


def test_a_sensor_board_reports_them_likewise(library_case):
    lines = [line.split() for line in library_case('settings_alone_in_frames').splitlines()]
    frames = [(int(ms), mcu_at(bytes.fromhex(frame), 0)) for ms, frame in lines]
    assert [(ms, frame.data[0]) for ms, frame in frames] == list(enumerate(NUMBERS)) + [
        (1000 * (index + 1), NUMBERS[index % 6]) for index in range(19)]
    assert all(frame.type == MCU_SETTING for _, frame in frames)


def test_settings_follow_the_chunks_of_an_announcement(library_case):
    packets = packets_of(library_case('settings_beside_the_packets_of_the_car'))
    chunks = [ms for ms, packet in packets if packet.type == ANNOUNCEMENT]
    own = [(ms, number) for ms, number in reports(packets) if number != 2]
    assert [number for _, number in own[:5]] == [1, 3, 4, 5, 200]
    in_turn = [number for number in NUMBERS * 20 if number != 2]
    assert [number for _, number in own[5:]] == in_turn[:len(own) - 5]
    assert len(own) - 5 > len(chunks) * 4 // 6
    # Every setting that arrives is answered within the 10 ms of the sketch's own packets.
    answers = [ms for ms, number in reports(packets) if number == 2]
    assert all(any(0 <= answer - ms < 10 for answer in answers) for ms in range(0, 9000, 50))


# The sketches, on the emulated chip


def stops_in_time(car):
    """When nothing more is sent: check the time from the last heartbeat to PWM 0.

    Return the PWM before.
    """
    car.board.wait_until(lambda: car.board.get('motor_pwm') == 0, 1)
    before, (when, _) = car.board.history('motor_pwm')[-2:]
    assert 0 < when - car.board.get('last_rx_time') < 0.032
    return before[1]


def test_the_motor_stops_without_heartbeats_and_waits_for_a_new_target(firmware_build):
    with car_end(firmware_build, image='Tuning.elf') as car:
        set_to(car, 'f', 1, 200)
        set_to(car, 'f', 2, 1000)
        hold(car, target(8), 1)
        assert stops_in_time(car) > 0
        known = car.board.history('motor_pwm')
        hold(car, b'', 1)
        assert car.board.history('motor_pwm') == known
        hold(car, target(8), 1)
        assert car.board.history('motor_pwm') != known


def test_the_ramp_of_the_car_delays_a_rise_and_no_stop(car):
    def climb():
        """Seconds from PWM 100 to 255, of the latest rise."""
        hold(car, packet(SPEED, struct.pack('<h', 0)), 0.2)
        hold(car, packet(SPEED, struct.pack('<h', 1000)), 1)
        changes = {pwm: when for when, pwm in car.board.history('motor_pwm')}
        return changes[255] - changes.get(100, changes[255])

    def is_at_once():
        return climb() == 0
    assert again_if_stalled(is_at_once)
    set_to(car, 'H', 1, 500)

    def ramps():
        return climb() == pytest.approx(0.5 * 155 / 255, rel=0.03)
    assert again_if_stalled(ramps)
    assert stops_in_time(car) == 255
    set_to(car, 'H', 1, 60000, used=2000)


def test_the_sensor_board_has_another_period_and_forgets_it_at_a_reset(sensors):
    board = sensors.board
    sensors.port.write(mcu_frame(MCU_SETTING, 0, struct.pack('<BH', 1, 100)))
    board.wait_until(lambda: sensors.read() and struct.pack('<BH', 1, 100) in sensors.settings, 1)

    def period():
        """By the board's clock."""
        sensors.times = []
        sensors.next(11)
        times = [time for _, time in sensors.times]
        return (times[10] - times[0]) / 1e7

    def is_longer():
        return period() == pytest.approx(0.1, rel=0.1)
    assert again_if_stalled(is_longer)
    board.reset()
    sensors.forget_a_cut_frame()
    sensors.settings = []

    def is_as_before():
        return period() == pytest.approx(0.05, rel=0.1)
    assert again_if_stalled(is_as_before)
    board.wait_until(lambda: sensors.read() and len(sensors.settings) >= 2, 3)
    assert {struct.unpack('<BH', data) for data in sensors.settings} == {(1, 50), (2, 200)}
