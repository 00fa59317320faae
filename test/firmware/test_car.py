"""The firmware of the model car, nano_car, in its world. Its motor's stops: test_motor_stop.py."""
import math
import struct

import pytest
from by_definition import (CALIBRATION, IMU, LED, SETTING, STEERING_ANGLE, TICKS, TIME, VOLTAGE,
                           arduino_packet)

from packets import FORCE, HEARTBEAT, gripper, speed, steering

RATE_SCALE = 4000.0 / 65536 * math.pi / 180 * 25  # rad/s
ACCELERATION_SCALE = 8.0 / 65536 * 9.81  # m/s^2


def unpacked(layout, packets):
    return [struct.unpack(layout, data)[0] for data in packets]


def test_speeds_set_the_pwm_and_the_direction(car):
    for value, pwm, direction in ((400, 102, 1), (-400, 102, -1), (1000, 255, 1),
                                  (-3000, 255, -1), (7, 2, 1), (0, 0, 0)):
        car.beat = speed(value) + HEARTBEAT
        car.run(0.05)
        assert (car.get('motor_pwm'), car.get('motor_direction')) == (pwm, direction)


@pytest.mark.parametrize('image', ['nano_car_emulated.elf', 'Car.elf'])
def test_speed_zero_stops_at_once_and_both_inputs_are_low_before_another_direction(copy_of, image):
    car = copy_of('car', image)
    car.beat = speed(300) + HEARTBEAT
    car.run(0.1)
    car.beat = HEARTBEAT
    car.send(speed(0))
    car.run(0.002)
    assert car.get('motor_pwm') == 0
    for value in 300, -300:
        car.beat = speed(value) + HEARTBEAT
        car.run(0.1)
    (low, _), (high, _) = car.history('bridge_inputs')[-2:]
    assert [inputs for _, inputs in car.history('bridge_inputs')][-3:] == [1, 0, 2]
    assert 0.002 < high - low < 0.005


def test_ticks_are_the_turns_of_the_wheel(car):
    car.beat = speed(1000) + HEARTBEAT
    car.until(lambda: car.get('wheel_turns') > 5)
    car.beat = b''
    car.until(lambda: car.get('wheel_speed') == 0)
    car.run(0.05)
    ticks = unpacked('<B', car.seen(TICKS))
    assert sum(ticks) == car.get('wheel_ticks') and max(ticks) <= 11
    assert abs(sum(ticks) - 64 * car.get('wheel_turns')) <= 1


def test_steering_sets_the_servo_and_its_feedback_is_sent(car):
    for pulse, servo in (1000, 1000), (1501, 1501), (2000, 2000), (100, 1000), (65535, 2000):
        car.send(steering(pulse))
        car.run(0.05)
        assert car.get('servo_us') == servo
    for raw in 0, 300, 1023:
        car.set(steering_feedback=raw)
        car.next(STEERING_ANGLE)        # perhaps of before
        assert unpacked('<H', car.next(STEERING_ANGLE)) == [raw]


@pytest.mark.parametrize('command, lamps', [
    (b'left', [1, 0, 0]), (b'right', [0, 1, 0]), (b'brake', [0, 0, 1]), (b'hazard', [1, 1, 0]),
    (b'disable', [0, 0, 0])])
def test_lamps(car, command, lamps):
    car.send(arduino_packet(LED, b'brake\0') + arduino_packet(LED, command + b'\0'))
    for bright in 1, 0, 1:      # it blinks every 0.7 s; the brake lamp does not
        car.run(0.1)
        names = 'led_left', 'led_right', 'led_brake'
        assert list(map(car.get, names)) == [lamps[0] * bright, lamps[1] * bright, lamps[2]]
        car.run(0.25)


def test_battery_is_averaged_over_three_seconds(car):
    assert unpacked('<f', car.next(VOLTAGE, 3)) == pytest.approx([14.8] * 3, rel=0.01)
    car.set(battery=7.4)
    measured = unpacked('<f', car.next(VOLTAGE, 3))
    assert measured == pytest.approx([12.3, 9.9, 7.4], rel=0.03)


def test_each_group_of_packets_follows_its_time(car):
    car.forget()
    car.run(0.5)
    kinds = [frame.type for frame in car.received if frame.type != SETTING]
    groups = ' '.join(map(str, kinds)).split(str(TIME))[1:-1]
    assert {group.split()[0] for group in groups} == {str(TICKS)} and len(groups) >= 48
    times = unpacked('<I', [data[:4] for data in car.seen(TIME)])
    assert (times[-1] - times[0]) / (len(times) - 1) == pytest.approx(10_000, abs=20)
    told = [(frame.at, before.type == SETTING) for before, frame in zip(
        car.received[:1] + car.received, car.received) if frame.type == TIME]
    # It waits for the line while a setting is sent.
    assert all(0 < at - time * 1e-6 < (0.004 if waits else 0.003)
               for (at, waits), time in zip(told, times))


# The IMU


def imu_values(data):
    """Orientation (w, x, y, z), rates, accelerations, temperature; in ROS's axes and units."""
    def turned(x, y, z):
        return y, -x, z
    fields = struct.unpack('>11h', data)
    w, x, y, z = [value / 16384.0 for value in fields[:4]]
    return ((w, *turned(x, y, z)), turned(*(value * RATE_SCALE for value in fields[4:7])),
            turned(*(value * ACCELERATION_SCALE for value in fields[7:10])),
            fields[10] / 340.0 + 36.53)


def yaw(car):
    """Degrees, by the next orientation."""
    w, _, _, z = imu_values(car.next(IMU)[0])[0]
    return math.degrees(2 * math.atan2(z, w))


def drift(car):
    """Degrees that the orientation turns in a second."""
    before = yaw(car)
    car.run(1)
    return yaw(car) - before


def test_imu_at_rest_and_turned(car):
    car.set(imu_temperature=25)
    car.next(IMU, 3)
    quaternion, rates, accelerations, temperature = imu_values(car.next(IMU)[0])
    assert quaternion == pytest.approx((1, 0, 0, 0), abs=0.01)
    assert rates == pytest.approx((0, 0, 0), abs=0.03)
    assert accelerations == pytest.approx((0, 0, 9.81), abs=0.05)
    assert temperature == pytest.approx(25, abs=0.01)
    half = math.radians(30) / 2
    for axis, part in ('roll', 1), ('pitch', 2), ('yaw', 3):
        car.set(**{axis: 30})
        car.until(lambda: not car.get('turning'))
        wanted = [math.cos(half), 0, 0, 0]
        wanted[part] = math.sin(half)
        assert imu_values(car.next(IMU)[0])[0] == pytest.approx(wanted, abs=0.02)
        car.set(**{axis: 0})
        car.until(lambda: not car.get('turning'))


def test_calibration_takes_the_drift_away_and_survives_a_power_cycle(car):
    car.says('IMU ready, not calibrated')
    car.set(gyro_bias_z=4, gyro_bias_x=-1, accel_bias_y=0.05)
    assert drift(car) == pytest.approx(4, abs=1)
    began = car.now
    car.send(arduino_packet(CALIBRATION))
    car.says('IMU calibration')
    car.set(imu_failures=5)     # a few failed reads do not end it
    car.forget()
    # No IMU data and no input: not now, and not afterwards. The rest goes on.
    car.beat = steering(1900) + speed(500) + HEARTBEAT
    car.run(2)
    car.beat = HEARTBEAT
    car.says('IMU calibrated')
    assert car.now - began > 2.9
    assert car.seen(IMU) == [] and len(car.seen(TICKS)) > 250
    assert car.get('servo_us') == 1500 and car.history('motor_pwm') == [(0, 0)]
    assert abs(drift(car)) < 0.2
    car.forget()
    car.ask('power_cycle')
    car.says('IMU ready')
    assert 'IMU ready' in car.texts()
    assert abs(drift(car)) < 0.2
    assert imu_values(car.next(IMU)[0])[2] == pytest.approx((0, 0, 9.81), abs=0.05)


def test_a_car_that_moves_is_not_calibrated(car):
    car.send(arduino_packet(CALIBRATION))
    car.says('IMU calibration')
    car.set(yaw=90)
    car.says('car moved, calibration dropped')
    car.ask('power_cycle')
    car.says('IMU ready, not calibrated')


@pytest.mark.parametrize('line', ['sda_stuck', 'scl_stuck'])
def test_the_rest_goes_on_without_the_bus_of_the_imu(car, line):
    car.set(**{line: 1000})
    car.says('IMU does not answer')
    car.forget()
    car.run(1)
    assert len(car.seen(TICKS)) == pytest.approx(100, abs=2) and car.seen(IMU) == []
    car.set(**{line: 0})
    car.says('IMU ready')


def test_a_reset_in_the_middle_of_a_read_frees_the_line(booted):
    """The device holds SDA until it has the clocks of the rest of its byte."""
    for number in range(500):       # a read takes 0.4 of 10 ms
        car = booted('car').copy()
        car.run(2e-5 * number)
        car.ask('reset')
        held = car.get('sda_stuck')
        if held:
            car.forget()
            car.says('IMU ready')
        car.close()
        if held:
            return
    raise AssertionError('no reset was in the middle of a read')


# Settings, and custom messages


def test_settings_are_used_within_their_limits_and_forgotten_at_a_reset(car):
    def use(number, layout, value):
        car.forget()
        car.send(arduino_packet(SETTING, struct.pack('<B' + layout, number, value)))
        car.run(0.05)
        return unpacked('<x' + layout,
                        [data for data in car.seen(SETTING) if data[0] == number])[-1]

    def climb():
        """Seconds in which the PWM rises from 100 to 255."""
        car.beat = speed(0) + HEARTBEAT
        car.run(0.2)
        car.beat = speed(1000) + HEARTBEAT
        car.run(1)
        changes = {pwm: when for when, pwm in car.history('motor_pwm')}
        return changes[255] - changes.get(100, changes[255])
    assert climb() == 0
    assert use(1, 'H', 500) == 500
    assert climb() == pytest.approx(0.5 * 155 / 255, rel=0.03)
    car.beat = b''
    car.run(0.2)        # a ramp delays no stop
    assert 0.03 < car.history('motor_pwm')[-1][0] - car.get('last_rx_time') <= 0.033
    assert use(1, 'H', 60000) == 2000
    assert use(2, 'H', 200) == 200
    for pulse, servo in (1000, 1300), (2000, 1700):
        car.send(steering(pulse))
        car.run(0.05)
        assert car.get('servo_us') == servo
    assert use(3, 'B', 0) == 1 and use(3, 'B', 20) == 20
    car.forget()
    car.run(1)
    assert len(car.seen(IMU)) == 20 and len(car.seen(TICKS)) == pytest.approx(100, abs=2)
    car.ask('reset')
    car.forget()
    car.run(1)
    assert {tuple(data) for data in car.seen(SETTING)} == {(1, 0, 0), (2, 244, 1), (3, 100)}


def test_custom_messages(copy_of):
    car = copy_of('car', 'nano_car_custom.elf')
    for raw in 0, 500, 1023:
        car.set(force=raw)
        car.next(FORCE)         # perhaps of before
        assert car.next(FORCE) == [struct.pack('<h', raw * 29)]
    for position, force, pwm in ((1000, 1, 255), (0, 255, 127), (-900, 9, 12), (3000, 9, 255),
                                 (500, 0, 0)):
        car.send(gripper(position, force))
        car.run(0.05)
        assert car.get('gripper_pwm') == pwm
    car.send(gripper(1000, 1)[:-3] + b'\0')     # another length, or another code: dropped
    car.run(0.05)
    assert car.get('gripper_pwm') == 0
