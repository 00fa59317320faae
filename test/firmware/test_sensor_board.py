"""The firmware of the sensor board, range_imu, on an AVR; as on an ESP32: test_esp32_board.py."""
import struct

import pytest
from by_definition import SENSORS, SETTING, mcu_frame

MCU_TIME, MCU_SETTING = 0xFE, SETTING
TIMED_OUT, UNKNOWN, KNOWN = 0xFFFF, (-32768, -32768), (-1225, 3300)     # pitch and roll


def status(sensors):
    """The next frame: both ranges, yaw, (pitch, roll)."""
    one, two, yaw, *angles = struct.unpack('<HHhhh', sensors.next(SENSORS)[0])
    return one, two, yaw, tuple(angles)


def test_values_arrive(sensors):
    """A heading of 350 degrees does not fit into the frame, and wraps."""
    for values in (500, 8190, 90.5, -12.25, 33), (47, 58, 350, -2.4375, 2.4375):
        sensors.set(**dict(zip(('range1', 'range2', 'heading', 'pitch', 'roll'), values)))
        sensors.run(0.15)
        one, two, yaw, angles = status(sensors)
        assert (one, two) == values[:2]
        assert (yaw % 65536, *angles) == pytest.approx([100 * each for each in values[2:]], abs=1.1)


def test_each_frame_follows_its_time_twenty_times_a_second(sensors):
    sensors.next(SENSORS)
    sensors.forget()
    sensors.run(2)
    frames = sensors.received
    numbers = [frame.number for frame in frames]
    assert numbers == [(numbers[0] + index) % 256 for index in range(len(numbers))]
    timed = [(before, frame) for before, frame in zip(frames, frames[1:]) if frame.type == SENSORS]
    assert len(timed) == 40 and {before.type for before, _ in timed} == {MCU_TIME}
    times = [struct.unpack('<I', before.data)[0] * 1e-6 for before, _ in timed]
    assert all(after - before == pytest.approx(0.05, abs=0.003)
               for before, after in zip(times, times[1:]))
    assert all(0 < before.at - time < 0.005 for (before, _), time in zip(timed, times))


@pytest.mark.parametrize('fault, value, cure', [
    ('range2_alive', 0, 1), ('range2_present', 0, 1), ('range2_error', 2, 2)])
def test_a_range_sensor_with_a_fault_has_no_range_until_it_was_started_again(
        sensors, fault, value, cure):
    sensors.set(range2=333)
    sensors.run(0.2)
    sensors.set(**{fault: value})
    sensors.until(lambda: status(sensors)[:2] == (800, TIMED_OUT))
    if cure != value:       # only a reset ends an error
        sensors.run(1.5)
        assert status(sensors)[:2] == (800, TIMED_OUT)
        sensors.set(**{fault: cure})
    sensors.until(lambda: status(sensors)[:2] == (800, 333))


@pytest.mark.parametrize('fault, value', [('bno055_present', 0), ('bno055_error', 1)])
def test_angles_are_unknown_until_the_bno055_was_started_again(sensors, fault, value):
    sensors.set(pitch=-12.25, roll=33)
    sensors.until(lambda: status(sensors)[3] == KNOWN)
    sensors.set(**{fault: value})
    sensors.until(lambda: status(sensors)[3] == UNKNOWN, 0.2)
    assert status(sensors)[:2] == (800, 800)
    sensors.set(bno055_present=1)       # without its mode: it answers, and its angles are 0
    found = {UNKNOWN}
    sensors.until(lambda: found.add(status(sensors)[3]) or KNOWN in found)
    assert found == {UNKNOWN, KNOWN} and sensors.get('bno055_error') == 0


@pytest.mark.parametrize('line, value, cure', [('sda_stuck', 1000, 9), ('scl_stuck', 1, 0)])
def test_frames_go_on_without_the_i2c_bus(sensors, line, value, cure):
    sensors.set(**{line: value})
    sensors.until(lambda: status(sensors)[:2] == (TIMED_OUT, TIMED_OUT))
    sensors.forget()
    sensors.run(1)
    assert len(sensors.seen(SENSORS)) == pytest.approx(20, abs=1)
    sensors.set(**{line: cure})
    sensors.until(lambda: status(sensors)[:2] == (800, 800))


def test_settings_are_used_within_their_limits_and_forgotten_at_a_reset(sensors):
    def frames_a_second():
        sensors.forget()
        sensors.run(1)
        return len(sensors.seen(SENSORS))
    for value, used, frames in (100, 100, 10), (5, 20, 50), (65535, 500, 2):
        sensors.forget()
        sensors.send(mcu_frame(MCU_SETTING, 0, struct.pack('<BH', 1, value)))
        sensors.run(0.05)
        assert struct.pack('<BH', 1, used) in sensors.seen(MCU_SETTING)
        assert frames_a_second() == pytest.approx(frames, abs=1)
    sensors.ask('reset')
    assert frames_a_second() == pytest.approx(20, abs=1)
    assert {struct.unpack('<BH', data) for data in sensors.seen(MCU_SETTING)} == {
        (1, 50), (2, 200)}
