"""I2C lines that are held low: for the clocks that a device waits for, and for good."""

import subprocess

import pytest

from board_ends import (
    CALIBRATION, ENVIRONMENT, ERROR, IMU, OK, TICKS, angle_between, board_times, comes_at,
    imu_values,
)


def free(board):
    return board.get('sda_stuck') == 0


@pytest.mark.parametrize('clocks', [1, 9])
def test_car_frees_a_held_sda(car, clocks):
    car.next(IMU, 3)
    car.board.set('sda_stuck', clocks)
    car.board.wait_until(lambda: free(car.board), 2)
    car.next(IMU, 20, seconds=3)


def test_car_reset_in_the_middle_of_a_read_finds_its_imu(car):
    board = car.board
    for _ in range(2):
        car.next(IMU, 3)
        car.forget()
        board.ask('dtr_in_read')
        board.wait_until(lambda: board.get('sda_stuck') > 0, 1)    # it is reset
        car.wait_for_text('IMU ready', seconds=2)
        assert free(board)
        assert 'IMU does not answer' not in [text for _, text in car.texts()]


@pytest.mark.parametrize('line', ['sda_stuck', 'scl_stuck'])
def test_car_goes_on_without_its_bus(car, line):
    car.board.set(line, 1000)
    car.wait_for_text('IMU does not answer')
    assert comes_at(car, TICKS, 100)
    car.board.set(line, 0)
    car.wait_for_text('IMU ready')


@pytest.mark.parametrize('line', ['sda_stuck', 'scl_stuck'])
def test_bus_board_answers_without_its_bus(bus, line):
    board = bus.board
    board.wait_until(lambda: bus.function(ENVIRONMENT)[:1] == OK, 2)
    board.set(line, 1000)
    board.wait_until(lambda: bus.function(ENVIRONMENT)[:1] != OK, 4)
    for _ in range(50):
        assert bus.ask(1, 0, b'ping') == b'\x01ping'
        assert board.get('last_tx_time') - board.get('last_rx_time') < 0.05
    board.set(line, 5 if line == 'sda_stuck' else 0)
    board.wait_until(lambda: bus.function(ENVIRONMENT)[:1] == OK, 3)
    assert free(board)


@pytest.mark.parametrize('line', ['sda_stuck', 'scl_stuck'])
def test_sensor_board_sends_without_its_bus(sensors, line):
    board = sensors.board
    board.wait_until(lambda: sensors.next()[0][1:3] == (800, 800), 2)
    board.set(line, 1000)
    board.wait_until(lambda: sensors.next()[0][1:3] == (0xFFFF, 0xFFFF), 2)
    sensors.next(21)
    assert sensors.times[-1][1] - sensors.times[-21][1] == pytest.approx(1e6, rel=0.05)
    board.set(line, 9 if line == 'sda_stuck' else 0)
    board.wait_until(lambda: sensors.next()[0][1:3] == (800, 800), 4)
    assert free(board)


# Sensors that lose their power, and sensors that are not there


def test_an_imu_without_power_for_a_moment_is_started_again(car):
    """It comes back asleep: it answers, with zeros."""
    for _ in range(2):
        car.next(IMU, 3)
        car.forget()
        car.board.set('imu_present', 0)
        car.board.set('imu_present', 1)
        car.wait_for_text('IMU does not answer', seconds=2)
        car.wait_for_text('IMU ready', seconds=3)
        accelerations = [imu_values(data)[2] for data in car.read(IMU)]
        # One packet may have been on its way when it lost its power.
        assert [a for a in accelerations if a[2] == pytest.approx(9.81, abs=0.1)] == accelerations
        assert angle_between(car.orientation(), (1, 0, 0, 0)) < 2


def test_an_imu_that_falls_asleep_ends_a_calibration(car):
    car.send(CALIBRATION)
    car.wait_for_text('IMU calibration')
    car.forget()
    car.board.set('imu_present', 0)
    car.board.set('imu_present', 1)
    car.wait_for_text('IMU does not answer', seconds=2)
    car.wait_for_text('IMU ready', seconds=3)
    assert 'IMU calibrated, IMU ready' not in [text for _, text in car.texts()]


def test_a_few_failed_reads_are_not_worth_a_word(car):
    car.next(IMU)
    car.forget()
    car.board.set('imu_failures', 5)
    car.board.wait_until(lambda: car.board.get('imu_failures') == 0, 1)
    car.next(IMU, 20)
    assert car.texts() == []


def test_a_missing_imu_is_said_once_and_then_every_10_s(car):
    car.forget()
    car.board.set('imu_present', 0)
    car.wait_for_text('IMU does not answer')
    car.board.wait_until(lambda: car.read() is not None and len(car.texts()) > 1, 12)
    assert car.texts() == [(ERROR, 'IMU does not answer')] * 2
    first, second = [at for at, (kind, _) in enumerate(car.packets) if kind == ERROR]
    times = board_times(car.packets[first:second])
    assert times[-1] - times[0] == pytest.approx(10, abs=0.5)


def test_an_sht3x_that_hangs_is_reset(bus):
    board = bus.board
    board.wait_until(lambda: bus.function(ENVIRONMENT)[:1] == OK, 2)
    board.set('sht3x_hangs', 1)
    board.wait_until(lambda: board.get('sht3x_hangs') == 0, 1)
    start = board.time
    board.wait_until(lambda: board.time > start + 2.5, 4)    # longer than a reading is valid
    assert bus.function(ENVIRONMENT)[:1] == OK


def test_an_old_reading_is_not_valid_again_after_49_days(built):
    """When millis() wraps, its time seems to be now."""
    assert subprocess.check_output([built('old_reading')]) == b'10'
