"""The boards' firmware in an emulated ATmega328P, seen on the wire and over the control channel.

What is timed is timed in emulated seconds: a slow machine makes a test longer, not wrong.
"""

import struct

import pytest

from board_ends import (
    ANGLE, CALIBRATION, DOWN, ENVIRONMENT, ERROR, FORCE, GIMBAL, GRIPPER, HEARTBEAT, IMU, INFO,
    LED, LIFT, OK, PUMP, SPEED, STEERING, TANK, TICKS, TIME, UP, VOLTAGE, angle_between,
    car_end, drive_until, driving, error, from_euler, imu_values, master_end, packet, request,
)

# The model car


@pytest.mark.parametrize('speed, pwm, direction', [
    (400, 102, 1), (-400, 102, -1), (1000, 255, 1), (-3000, 255, -1), (7, 2, 1)])
def test_speed_command_sets_the_pwm(car, speed, pwm, direction):
    car.drive(speed)
    car.board.wait_until(lambda: len(car.board.history('motor_pwm')) == 3
                         and len(car.board.history('motor_direction')) == 3, 1)
    assert [value for _, value in car.board.history('motor_pwm')] == [0, pwm, 0]
    assert [value for _, value in car.board.history('motor_direction')] == [0, direction, 0]


def test_speed_without_heartbeats_does_nothing(car):
    car.send(SPEED, struct.pack('<h', 500))
    car.send(STEERING, struct.pack('<H', 1234))
    car.board.wait_until(lambda: car.board.get('servo_us') == 1234, 1)
    assert car.board.history('motor_pwm') == [(0, 0)]


def test_heartbeats_alone_do_not_start_a_motor_that_has_stopped_without_them(car):
    """How soon it stops: test_motor_stop.py."""
    board = car.board
    car.port.write(driving(700) * 3 + packet(HEARTBEAT))
    car.wait_for_text('heartbeat lost')
    assert board.get('motor_pwm') == 0
    car.forget()
    for _ in range(20):
        car.send(HEARTBEAT)
    received = board.get('rx_bytes')
    board.wait_until(lambda: board.get('rx_bytes') >= received
                     and len(car.next(TICKS, 10)) == 10, 2)
    assert board.get('motor_pwm') == 0


def test_speed_zero_stops_at_once(car):
    # In one go: speed, 10 ms of heartbeats, speed 0, heartbeats for longer than their timeout.
    car.port.write(driving(300) + packet(HEARTBEAT) * 38 + driving(0) + packet(HEARTBEAT) * 200)
    history = car.board.history
    car.board.wait_until(lambda: len(history('motor_pwm')) == 3, 1)
    assert [value for _, value in history('motor_pwm')] == [0, 77, 0]
    assert history('motor_pwm')[2][0] - history('motor_pwm')[1][0] == pytest.approx(
        0.0105, abs=0.004)
    car.next(TICKS, 10)
    assert not [text for _, text in car.texts() if 'heartbeat' in text]


def test_ticks_are_the_wheels_turns(car):
    board = car.board
    drive_until(car, 1000, lambda: board.get('wheel_turns') > 10)
    board.wait_until(lambda: car.read() is not None and board.get('wheel_speed') == 0, 5)
    board.wait_until(lambda: sum(data[0] for data in car.read(TICKS)) >= board.get('wheel_ticks'),
                     2)
    ticks = sum(data[0] for data in car.read(TICKS))
    assert ticks == board.get('wheel_ticks')
    assert abs(ticks - 64 * board.get('wheel_turns')) <= 1
    assert max(data[0] for data in car.read(TICKS)) <= 11  # 15 turns of 64 ticks a second


@pytest.mark.parametrize('pulse, servo', [
    (1000, 1000), (1501, 1501), (2000, 2000), (100, 1000), (65535, 2000)])
def test_steering_command_sets_the_servo(car, pulse, servo):
    car.send(STEERING, struct.pack('<H', pulse))
    car.board.wait_until(lambda: car.board.get('servo_us') == servo, 1)


def test_steering_feedback(car):
    for raw in (0, 300, 1023):
        car.board.set('steering_feedback', raw)
        car.next(ANGLE, 3)
        assert struct.unpack('<H', car.next(ANGLE)[0])[0] == raw


@pytest.mark.parametrize('command, lamps', [
    ('left', (1, 0, 0)), ('right', (0, 1, 0)), ('brake', (0, 0, 1)), ('hazard', (1, 1, 0))])
def test_lamps(car, command, lamps):
    board = car.board
    names = ('led_left', 'led_right', 'led_brake')
    car.send(LED, command.encode('ascii') + b'\x00')
    board.wait_until(lambda: tuple(board.get(name) for name in names) == lamps, 5)
    if command != 'brake':
        lit = names[lamps.index(1)]
        board.wait_until(lambda: len(board.history(lit)) >= 5, 3)  # it blinks
    car.send(LED, b'disable\x00')
    board.wait_until(lambda: not any(board.get(name) for name in names), 1)
    assert not [text for kind, text in car.texts() if 'LED' in text]


def test_battery_within_one_percent(car):
    assert struct.unpack('<f', car.next(VOLTAGE)[0])[0] == pytest.approx(14.8, rel=0.01)
    car.board.set('battery', 7.4)
    # Three seconds of averages, and the second in which it changed.
    measured = [struct.unpack('<f', data)[0] for data in car.next(VOLTAGE, 4, seconds=6)]
    assert measured == sorted(measured, reverse=True)
    assert measured[-1] == pytest.approx(7.4, rel=0.01)


def test_imu_at_rest(car):
    car.board.set('imu_temperature', 25.0)
    car.next(IMU, 3)
    orientation, rates, accelerations, temperature = imu_values(car.next(IMU)[0])
    assert angle_between(orientation, (1, 0, 0, 0)) < 0.5
    assert max(abs(rate) for rate in rates) < 0.03
    assert accelerations == pytest.approx((0, 0, 9.81), abs=0.05)
    assert temperature == pytest.approx(25.0, abs=0.01)


def test_each_group_of_the_car_follows_its_time(car):
    """Every 10 ms of the board's clock; what the line holds back does not change it."""
    car.next(TIME, 50)
    kinds = [kind for kind, _ in car.packets if kind > ERROR]
    groups = ' '.join(map(str, kinds[kinds.index(TIME):])).split(str(TIME))[1:-1]
    assert len(groups) >= 48
    assert {group.split()[0] for group in groups} == {str(TICKS)}
    times = [struct.unpack('<IB', data) for data in car.read(TIME)]
    assert {count for _, count in times} == {16}
    steps = [after - before for (before, _), (after, _) in zip(times, times[1:])]
    assert sum(steps) / len(steps) == pytest.approx(10_000, abs=20)
    assert max(abs(step - 10_000) for step in steps) < 2_500


def turn_to(car, **angles):
    for name, angle in angles.items():
        if car.board.get(name) != angle:
            car.board.set(name, angle)
    car.board.wait_until(lambda: car.read() is not None and car.board.get('turning') == 0, 10)
    car.next(IMU, 5)


@pytest.mark.parametrize('yaw, pitch, roll', [
    (-100, 0, 0), (60, -15, 10)])
def test_rotation_of_the_world_is_rotation_in_the_packets(car, yaw, pitch, roll):
    turn_to(car, yaw=yaw)
    turn_to(car, pitch=pitch)
    turn_to(car, roll=roll)
    assert angle_between(car.orientation(), from_euler(yaw, pitch, roll)) < 2


def yaw_drift(car):
    """Degrees that the orientation turns in one emulated second."""
    packets = car.next(IMU, 101)
    return angle_between(imu_values(packets[0])[0], imu_values(packets[-1])[0])


def test_calibration_takes_the_drift_away_and_survives_a_power_cycle(firmware_build, tmp_path):
    eeprom = str(tmp_path / 'eeprom')
    with car_end(firmware_build, eeprom=eeprom) as car:
        board = car.board
        board.set('gyro_bias_z', 4)
        board.set('gyro_bias_x', -1)
        board.set('accel_bias_y', 0.05)
        car.wait_for_text('IMU ready, not calibrated')
        assert yaw_drift(car) == pytest.approx(4, abs=1)

        started = board.time
        car.send(CALIBRATION)
        car.wait_for_text('IMU calibration')
        board.set('imu_failures', 5)    # a few failed reads do not end it
        car.forget()
        # No IMU data, and no input: not now and not afterwards. The rest goes on.
        car.send(STEERING, struct.pack('<H', 1900))
        car.drive(500)
        car.next(TICKS, 100)
        car.wait_for_text('IMU calibrated', seconds=10)
        assert board.time - started > 2.9
        texts_at = [index for index, packet in enumerate(car.packets) if packet[0] == INFO][0]
        assert not [packet for packet in car.packets[:texts_at] if packet[0] == IMU]
        assert yaw_drift(car) < 0.2
        assert board.get('servo_us') == 1500
        assert board.history('motor_pwm') == [(0, 0)]

        car.forget()
        board.power_cycle()
        car.wait_for_text('IMU ready')
        assert (INFO, 'IMU ready') in car.texts()
        assert yaw_drift(car) < 0.2
        accelerations = imu_values(car.next(IMU)[0])[2]
        assert accelerations == pytest.approx((0, 0, 9.81), abs=0.05)
    with open(eeprom, 'rb') as file:
        content = file.read()
    # A failing supply damages the first cell.
    assert content[:16] == b'\xff' * 16 and content[16:20] == b'IMU1'
    with car_end(firmware_build, eeprom=eeprom) as car:
        car.wait_for_text('IMU ready')
        assert (INFO, 'IMU ready') in car.texts()


# The control board

def test_invalid_before_sync(master):
    assert master.function(LIFT, bytes([UP, 10])) == b'\xff\x10'
    assert master.ask(1, 0, b'ping') == b'\xff\x10'
    assert master.board.get('lift_steps') == 0
    master.sync()
    assert master.ask(1, 0, b'ping') == b'\x01ping'


def test_echo_of_every_size(bus):
    for size in (0, 1, 4, 60, 254, 255, 300):
        data = bytes(index % 256 for index in range(size))
        assert bus.ask(1, 0, data) == b'\x01' + data


def test_errors(bus):
    assert bus.function(0x77) == error(0x8000)
    assert bus.ask(0x0A) == error(0x8000)
    assert bus.function(LIFT, bytes([2, 10])) == error(0x8001)
    assert bus.function(LIFT, bytes([0])) == error(0x8001)
    assert bus.function(GIMBAL, bytes([4, 10])) == error(0x8001)
    assert bus.function(GIMBAL, bytes([0, 10, 0])) == error(0x8001)
    for axis in ('lift', 'pan', 'tilt'):
        assert bus.board.get(axis + '_steps') == 0


def test_damaged_and_too_long_requests_are_invalid(bus):
    damaged = bytearray(request(0x55, LIFT, bytes([UP, 100])))
    damaged[5] ^= 0x04
    bus.write(bytes(damaged))
    assert bus.reply() == b'\xff\x40'
    bus.write(request(1, 0, bytes(301)))
    assert bus.reply() == b'\xff\x20'
    bus.silence(0.2)
    assert bus.ask(1, 0, b'next') == b'\x01next'
    assert bus.board.get('lift_steps') == 0


def test_a_request_after_noise_is_executed_once(bus):
    for count, noise in enumerate((b'\xa5', b'\xa5\x02', b'\x5a\xff\xff', b'\xa5\x00\x00\x00\x00',
                                   b'\x00\xff\x12'), 1):
        bus.write(noise + request(0x55, GIMBAL, bytes([0, 2])))
        assert bus.reply(seconds=3) == OK
        bus.silence(0.1)
        assert bus.board.get('pan_steps') == 20 * count


@pytest.mark.parametrize('direction, distance', [(DOWN, 255), (UP, 1), (UP, 37)])
def test_lift_moves_by_what_was_asked_once(bus, direction, distance):
    board = bus.board
    start = board.time
    assert bus.function(LIFT, bytes([direction, distance])) == OK
    taken = board.get('last_tx_time') - start
    sign = 1 if direction == UP else -1
    assert board.get('lift_steps') == sign * distance * 25
    assert board.get('lift_position') == 300 + sign * distance
    assert board.get('lift_moves') == 1
    # The reply came when the lift had stopped, and within the Master's five seconds.
    assert start < board.get('lift_last_step') < start + taken < start + 5
    assert taken > distance / 80.0
    bus.silence(0.1)
    assert board.get('lift_steps') == sign * distance * 25


@pytest.mark.parametrize('direction, axis, sign', [
    (0, 'pan', 1), (1, 'pan', -1), (2, 'tilt', 1), (3, 'tilt', -1)])
def test_gimbal_turns_by_what_was_asked_once(bus, direction, axis, sign):
    assert bus.function(GIMBAL, bytes([direction, 30])) == OK
    assert bus.board.get(axis + '_steps') == sign * 300
    assert bus.board.get(axis + '_position') == sign * 30
    assert bus.board.get(axis + '_moves') == 1
    for other in {'lift', 'pan', 'tilt'} - {axis}:
        assert bus.board.get(other + '_steps') == 0


def test_gimbal_refuses_what_is_beyond_its_limit(bus):
    assert bus.function(GIMBAL, bytes([2, 91])) == error(0x8002)
    assert bus.function(GIMBAL, bytes([0, 171])) == error(0x8002)
    assert bus.board.get('tilt_steps') == bus.board.get('pan_steps') == 0
    assert bus.function(GIMBAL, bytes([3, 90])) == OK
    assert bus.function(GIMBAL, bytes([3, 1])) == error(0x8002)
    assert bus.board.get('tilt_position') == -90


def test_end_switch_stops_the_lift(bus):
    bus.board.set('lift_top', 320)
    assert bus.function(LIFT, bytes([UP, 100])) == error(0x8002)
    assert 320 <= bus.board.get('lift_position') < 320.5
    assert bus.function(LIFT, bytes([UP, 1])) == error(0x8002)  # refused: the switch is closed
    assert 320 <= bus.board.get('lift_position') < 320.5
    assert bus.function(LIFT, bytes([DOWN, 20])) == OK
    assert bus.board.get('lift_moves') == 2


def test_environment(bus):
    board = bus.board
    for smoke, temperature, humidity in ((350, 25.63, 48.12), (1023, -12.5, 100), (0, 0, 0)):
        board.set('smoke', smoke)
        board.set('temperature', temperature)
        board.set('humidity', humidity)
        changed = board.time
        board.wait_until(lambda: board.time > changed + 0.6, 2)  # two measurements
        for frame in (bytes.fromhex('a5025522d0'), request(0x55, ENVIRONMENT)):
            bus.write(frame)
            reply = bus.reply()
            assert reply[:1] == OK
            measured = struct.unpack('<HhH', reply[1:])
            assert measured[0] == smoke
            assert measured[1] == pytest.approx(temperature * 100, abs=1)
            assert measured[2] == pytest.approx(humidity * 100, abs=1)


# Custom messages: the example behind -DCUSTOM_MESSAGES


@pytest.fixture
def custom_car(firmware_build):
    with car_end(firmware_build, image='nano_car_custom.elf') as car:
        car.wait_for_text('IMU ready')
        yield car
        assert car.board.get('rx_overruns') == 0


def test_a_custom_measurement(custom_car):
    for raw in (0, 500, 1023):
        custom_car.board.set('force', raw)
        custom_car.next(FORCE)     # may be of before
        assert custom_car.next(FORCE) == [struct.pack('<h', raw * 29)]


def test_a_custom_command(custom_car):
    board = custom_car.board
    for position, force, pwm in ((1000, 1, 255), (0, 255, 127), (-900, 9, 12), (500, 0, 0)):
        custom_car.send(GRIPPER, struct.pack('<hB', position, force))
        board.wait_until(lambda: board.get('gripper_pwm') == pwm, 1)
    custom_car.send(GRIPPER, b'\x01')    # too short: dropped
    custom_car.send(STEERING, struct.pack('<H', 1200))
    board.wait_until(lambda: board.get('servo_us') == 1200, 1)
    assert board.get('gripper_pwm') == 0


def test_custom_functions(firmware_build):
    with master_end(firmware_build, image='ctrl_board_custom.elf') as master:
        master.sync()
        for on in (1, 0):
            assert master.function(PUMP, bytes([on])) == OK
            assert master.board.get('pump') == on
        assert master.function(PUMP) == error(0x8001)
        for raw in (0, 300, 1023):
            master.board.set('tank', raw)
            assert master.function(TANK) == OK + struct.pack('<H', raw * 10)


# The sensor board


def test_sensor_values_arrive(sensors):
    for values in (500, 8190, 90.5, -12.25, 33), (47, 58, 0, -2.4375, 2.4375):
        for name, value in zip(('range1', 'range2', 'heading', 'pitch', 'roll'), values):
            sensors.board.set(name, value)
        sensors.next(3)
        frame = sensors.next()[0]
        assert frame[1:3] == values[:2]
        assert [angle / 100.0 for angle in frame[3:]] == pytest.approx(values[2:], abs=0.011)


def test_each_frame_of_the_sensor_board_follows_its_time(sensors):
    """20 times a second."""
    frames = sensors.next(21)
    times = dict(sensors.times)
    assert all((number - 1) % 256 in times for number, *_ in frames)
    measured = [times[(number - 1) % 256] for number, *_ in frames]
    assert [after - before for before, after in zip(measured, measured[1:])] == pytest.approx(
        [50_000] * 20, abs=3_000)


@pytest.mark.parametrize('fault', ['alive', 'present'])
def test_sensor_that_times_out(sensors, fault):
    board = sensors.board
    board.set('range2', 333)
    board.wait_until(lambda: sensors.next()[0][1:3] == (800, 333), 2)
    board.set('range2_' + fault, 0)
    board.wait_until(lambda: sensors.next()[0][2] == 0xFFFF, 2)
    assert sensors.next()[0][1] == 800
    board.set('range2_' + fault, 1)
    board.wait_until(lambda: sensors.next()[0][2] == 333, 3)


KNOWN, UNKNOWN = (-1225, 3300), (-32768, -32768)    # pitch and roll


@pytest.fixture
def tilted(sensors):
    """The sensor board, whose angles are KNOWN."""
    sensors.board.set('pitch', -12.25)
    sensors.board.set('roll', 33)
    sensors.board.wait_until(lambda: sensors.next()[0][4:] == KNOWN, 3)
    return sensors


@pytest.mark.parametrize('fault, value', [('bno055_present', 0), ('bno055_error', 1)])
def test_angles_are_unknown_while_the_bno055_is_gone_or_has_an_error(tilted, fault, value):
    board = tilted.board
    board.set(fault, value)
    board.wait_until(lambda: tilted.next()[0][4:] == UNKNOWN, 1)
    assert tilted.next()[0][1:3] == (800, 800)
    board.set('bno055_present', 1)    # without its mode: it answers, and its angles are 0
    frames = []

    def known():
        frames.extend(tilted.next())
        return frames[-1][4:] == KNOWN

    board.wait_until(known, 4 if fault == 'bno055_error' else 3)
    assert {frame[4:] for frame in frames} <= {KNOWN, UNKNOWN}
    assert board.get('bno055_error') == 0    # only a reset ends it


# The emulator
