"""I2C lines that are held low for good."""

import pytest

from board_ends import ENVIRONMENT, OK, TICKS, comes_at


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
    assert board.get('sda_stuck') == 0


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
    assert board.get('sda_stuck') == 0
