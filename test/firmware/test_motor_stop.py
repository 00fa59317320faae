"""The car's motor stops, whatever the board, its bus or its cable do at that moment."""

import os
import statistics

import pytest

from board_ends import HEARTBEAT, car_end, drive_until, driving, packet

# MOTOR_STOP_ROUNDS=1000 measures each condition so often, and prints what came out.
ROUNDS = int(os.environ.get('MOTOR_STOP_ROUNDS', '3'))

PWM = 179    # of speed 700
PWM_OF_THE_EXAMPLE = 178    # which does not round


def drive(car, pwm=PWM):
    drive_until(car, 700, lambda: car.board.get('motor_pwm') == pwm)


def print_times(what, taken):
    print('%s: %d times, %.1f / %.1f / %.1f ms (min / median / max)' % (
        what, len(taken), min(taken) * 1000, statistics.median(taken) * 1000, max(taken) * 1000))


def nothing(car):
    pass


def sda_stuck(car):
    car.board.set('sda_stuck', 1000)


def scl_stuck(car):
    car.board.set('scl_stuck', 1)


def uart_full(car):
    """More than the buffer holds, while nobody reads it."""
    car.board.ask('stall 0.02')
    car.port.write((driving(700) + packet(HEARTBEAT)) * 10)


def stalled(car):
    """Heartbeats and commands come while loop() is held up; it finds them afterwards."""
    car.board.ask('stall 0.1')
    car.port.write(driving(700) * 4)


def port_opened(car):
    car.board.ask('dtr')


def check_stop_times(car, condition, pwm):
    """Measures how long it takes from the last heartbeat to PWM 0, and checks it."""
    board = car.board
    taken = []
    for _ in range(ROUNDS):
        drive(car, pwm)
        condition(car)
        # With a speed, should this computer have been late and the motor stopped already.
        car.port.write(driving(700) + packet(HEARTBEAT))
        # Long enough for a loop() that was held up to read what had come meanwhile.
        board.wait_until(lambda: board.time - board.get('last_rx_time') > 0.15, 2)
        on, off = board.history('motor_pwm')[-2:]
        # Bytes that a full UART loses can make another speed: the link has no checksum.
        assert on[1] == pwm or (condition is uart_full and on[1] > 0)
        assert off[1] == 0
        taken.append(off[0] - board.get('last_rx_time'))
        if condition is port_opened:
            car.wait_for_text('IMU ready')
        board.set('sda_stuck', 0)
        board.set('scl_stuck', 0)
        car.forget()
    print_times(condition.__name__, taken)
    assert max(taken) <= 0.033
    if condition in (nothing, sda_stuck, scl_stuck):
        assert min(taken) >= 0.030    # nor is a heartbeat too early called lost


@pytest.mark.parametrize('condition', [
    nothing, sda_stuck, scl_stuck, uart_full, stalled, port_opened])
def test_time_from_the_last_heartbeat_to_pwm_0(car, condition):
    check_stop_times(car, condition, PWM)


@pytest.mark.parametrize('condition', [nothing, uart_full, stalled])
def test_the_motor_of_the_example_stops_likewise(firmware_build, condition):
    with car_end(firmware_build, image='Car.elf') as car:
        check_stop_times(car, condition, PWM_OF_THE_EXAMPLE)


@pytest.mark.parametrize('held_up', [0.05, 0.1])
def test_heartbeats_found_late_do_not_start_the_motor(car, held_up):
    board = car.board
    drive(car)
    board.ask('stall %g' % held_up)
    car.port.write(driving(700) * 6)
    board.wait_until(lambda: board.time - board.get('last_rx_time') > 0.2, 2)
    last = board.get('last_rx_time')
    assert not [when for when, pwm in board.history('motor_pwm') if pwm and when > last]
    car.wait_for_text('heartbeat lost')
    assert board.get('watchdog_resets') == 0
    drive(car)


def test_watchdog_ends_a_loop_that_hangs(car):
    board = car.board
    car.forget()
    board.ask('stall 10')
    board.wait_until(lambda: board.get('watchdog_resets') == 1, 1)
    car.wait_for_text('IMU ready')
