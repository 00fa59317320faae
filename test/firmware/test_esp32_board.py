"""The sensor board's program for the ESP32, run on the PC under sanitizers with models of its
sensors' registers; also with Pololu's own library for the VL53L0X, where it is installed."""
import os
import struct

import pytest

from board_ends import MCU_CHUNK, MCU_SETTING, MCU_TIME
from by_definition import SENSORS, mcu_at
from emulated_board import FIRMWARE
from compilers import HERE, PROTOCOL, STUBS, run

SKETCH = os.path.join(FIRMWARE, 'range_imu')
TIMED_OUT, UNKNOWN = 0xFFFF, (-32768, -32768)
# Where the IDE, arduino-cli and Debian's packages have libraries; or named by the variable.
FOLDERS = [os.environ.get('VL53L0X_LIBRARY', ''), '~/Arduino/libraries/VL53L0X',
           '/usr/share/arduino/libraries/VL53L0X']
POLOLU = next((folder for folder in map(os.path.expanduser, FOLDERS)
               if os.path.exists(os.path.join(folder, 'VL53L0X.cpp'))), '')


@pytest.fixture(scope='module', params=['stub', 'pololu'])
def program(request, tmp_path_factory):
    library = []
    if request.param == 'pololu':
        if not POLOLU:
            pytest.skip("Pololu's library VL53L0X is not installed; VL53L0X_LIBRARY names its "
                        'folder')
        library = ['-I', POLOLU, os.path.join(POLOLU, 'VL53L0X.cpp')]
    path = str(tmp_path_factory.mktemp('esp32') / 'board')
    command = ['g++', '-std=gnu++11', '-g', '-O1', '-funsigned-char', '-DARDUINO_ARCH_ESP32',
               '-DARDUINO=10819', '-fsanitize=address,undefined', '-fno-sanitize-recover=all',
               '-include', os.path.join(STUBS, 'esp32', 'Arduino.h'), *library,
               '-I', os.path.join(STUBS, 'esp32'), '-I', PROTOCOL, '-I', SKETCH,
               os.path.join(HERE, 'esp32_sensor_board.cpp'), '-x', 'c++',
               *(os.path.join(SKETCH, name) for name in (
                   'range_imu.ino', 'sensors.cpp', 'sensors_esp32.cpp')), '-o', path]
    status, output = run(command)
    assert status == 0, output
    return path


def frames(program, seconds, *events):
    """The frames: (milliseconds, range 1, range 2, yaw, (pitch, roll))."""
    status, output = run([program, str(seconds), *events], timeout=60)
    assert status == 0, output
    found, timed = [], -1
    for ms, data in map(str.split, output.splitlines()):
        frame = mcu_at(bytes.fromhex(data), 0)
        if frame and frame.type == MCU_TIME:
            timed = (frame.number + 1) % 256
            assert abs(struct.unpack('<I', frame.data)[0] / 1000 - int(ms)) <= 1
            continue
        if frame and frame.type in (MCU_CHUNK, MCU_SETTING):
            continue
        assert frame and frame.type == SENSORS and frame.number == timed
        one, two, yaw, pitch, roll = struct.unpack('<HHhhh', frame.data)
        found.append((int(ms), one, two, yaw, (pitch, roll)))
    return found


def between(found, begin, end):
    return [frame for frame in found if begin <= frame[0] < end]


def test_values_arrive_twenty_times_a_second(program):
    found = frames(program, 4, '0:heading=90.5', '2500:range1=47')
    assert {frame[1:] for frame in between(found, 1500, 2500)} == {(800, 600, 9050, (0, 0))}
    assert {frame[1] for frame in between(found, 2600, 4000)} == {47}
    times = [frame[0] for frame in between(found, 1500, 4000)]
    assert all(45 <= after - before <= 55 for before, after in zip(times, times[1:]))


@pytest.mark.parametrize('clocks', [1, 9])
def test_a_device_that_holds_sda_at_the_start_is_clocked_out(program, clocks):
    found = frames(program, 2, '0:sda_stuck=%d' % clocks)
    assert found[-1][1:] == (800, 600, 0, (0, 0))


def test_a_bus_that_stays_low_stops_no_frame(program):
    found = frames(program, 2, '0:sda_stuck=1000')
    assert {frame[1:3] + frame[4:] for frame in found} == {(TIMED_OUT, TIMED_OUT, UNKNOWN)}
    assert len(found) >= 38


@pytest.mark.parametrize('sensor', [1, 2])
def test_a_range_sensor_that_lost_its_power_is_started_again(program, sensor):
    name, other = 'range%d' % sensor, 3 - sensor
    found = frames(program, 8, '2000:%s_power=0' % name, '4000:%s_power=1' % name)
    assert {frame[sensor] for frame in between(found, 2300, 4000)} == {TIMED_OUT}
    assert {frame[sensor] for frame in between(found, 5300, 8000)} == {(800, 600)[sensor - 1]}
    assert {frame[other] for frame in between(found, 1500, 8000)} == {(800, 600)[other - 1]}


def test_a_range_sensor_with_a_fault_gives_no_value_and_is_reset(program):
    found = frames(program, 6, '2000:range1_error=2', '2000:range1=8190')
    ranges = [frame[1] for frame in between(found, 1900, 6000)]
    assert [each for each, before in zip(ranges[1:], ranges) if each != before] == [TIMED_OUT, 8190]
    assert ranges.index(8190) < 30


@pytest.mark.parametrize('fault, back', [('bno055_error=1', 0), ('bno055_power=0', 1)])
def test_angles_are_unknown_until_the_bno055_is_started_again(program, fault, back):
    found = frames(program, 10, '0:heading=90.5', '2000:' + fault,
                   *['3500:bno055_power=1'] * back)
    assert {frame[4] for frame in between(found, 2060, 2900)} == {UNKNOWN}
    assert {frame[3:] for frame in between(found, 6500, 10000)} == {(9050, (0, 0))}
    assert {frame[1:3] for frame in between(found, 1500, 10000)} == {(800, 600)}
