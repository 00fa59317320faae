"""range_imu as on an ESP32: it compiles for one, and runs on the PC; see esp32_sensor_board.cpp.

What the sketch does with its sensors is the same on an AVR: test_sensor_board.py.
"""
import os
import struct

import pytest
from by_definition import SENSORS, mcu_at

import compilers
from emulated_board import FIRMWARE

SKETCH = os.path.join(FIRMWARE, 'range_imu')
TIMED_OUT, UNKNOWN = 0xFFFF, -32768


@pytest.fixture(scope='module')
def frames(tmp_path_factory):
    """A function: the status frames of so many seconds: ms, range 1, range 2, yaw, pitch, roll."""
    path = compilers.program(
        tmp_path_factory.mktemp('esp32') / 'board', '-I', SKETCH,
        os.path.join(compilers.HERE, 'esp32_sensor_board.cpp'),
        *(os.path.join(SKETCH, name)
          for name in ('range_imu.ino', 'sensors.cpp', 'sensors_esp32.cpp')))

    def run(seconds, *values):
        status, output = compilers.run([path, str(seconds), *values])
        assert status == 0, output
        read = [(int(ms), mcu_at(bytes.fromhex(data), 0)) for ms, data in
                map(str.split, output.splitlines())]
        assert [frame.number for _, frame in read] == [index % 256 for index in range(len(read))]
        return [(ms, *struct.unpack('<HHhhh', frame.data)) for ms, frame in read
                if frame.type == SENSORS]
    return run


@pytest.mark.parametrize('source', sorted(
    name for name in os.listdir(SKETCH) if name.endswith(('.ino', '.cpp'))))
def test_it_compiles(source):
    compilers.check(compilers.ON_THE_ESP, os.path.join(SKETCH, source), '-include', 'Arduino.h')


def test_values_arrive_twenty_times_a_second(frames):
    found = [frame for frame in frames(4, 'heading=90.5', 'range2=47') if frame[0] > 1500]
    assert {frame[1:] for frame in found} == {(800, 47, 9050, 0, 0)}
    assert all(45 <= after[0] - before[0] <= 55 for before, after in zip(found, found[1:]))


@pytest.mark.parametrize('clocks', [1, 9])
def test_a_device_that_holds_sda_at_the_start_is_clocked_out(frames, clocks):
    assert frames(2, f'sda_stuck={clocks}')[-1][1:] == (800, 600, 0, 0, 0)


@pytest.mark.parametrize('fault, value', [
    ('range1=0', (TIMED_OUT, 600, 0, 0, 0)), ('range2=0', (800, TIMED_OUT, 0, 0, 0)),
    ('sda_stuck=1000', (TIMED_OUT, TIMED_OUT, 0, UNKNOWN, UNKNOWN))])
def test_a_fault_stops_no_frame(frames, fault, value):
    found = [frame for frame in frames(3, fault) if frame[0] > 1000]
    assert len(found) == pytest.approx(40, abs=1) and {frame[1:] for frame in found} == {value}
