"""I2C lines that are held low: for the clocks that a device waits for, and for good."""

import pytest

from board_ends import ENVIRONMENT, IMU, OK, TICKS, takes


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
    for _ in range(3):
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
    assert takes(car.board, lambda: car.next(TICKS, 100), 1)
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
    assert takes(board, lambda: sensors.next(40), 2)
    board.set(line, 9 if line == 'sda_stuck' else 0)
    board.wait_until(lambda: sensors.next()[0][1:3] == (800, 800), 4)
    assert free(board)
