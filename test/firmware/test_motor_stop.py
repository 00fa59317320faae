"""What drives stops by itself, whatever the board, its bus, its cable or the computer do."""

import pytest

from packets import (DOOR, HEARTBEAT, OK, PUMP, UP, cmd_vel, function, gripper, lift, request,
                     speed, target)

ROUNDS = 3
# What drives each image that needs heartbeats, and the outputs that are on then. A heartbeat is
# the last, so that the last byte that arrives is a heartbeat's.
DRIVEN = {
    'nano_car_custom': ('car', speed(700) + gripper(1000, 1), ['motor_pwm']),
    'Car': ('car', speed(700), ['motor_pwm']),
    'Tuning': ('car', target(8), ['motor_pwm']),
    'DiffDrive': ('diff', cmd_vel(0.4), ['left_pwm', 'right_pwm']),
}


def drive(board, orders, outputs):
    """Send orders until all outputs are on."""
    board.beat = orders + HEARTBEAT
    board.until(lambda: all(board.get(output) for output in outputs))


# What happens to the board at that moment, as lines of the emulator's control channel.
CONDITIONS = {
    'nothing': [],
    'I2C is held low': ['set sda_stuck 1000'],
    'the clock of I2C is held low': ['set scl_stuck 1'],
    'the port is opened, which resets the board': ['dtr'],
    'heartbeats are found late': ['stall 0.1'],
    'more arrives than the buffer holds': ['stall 0.02'],
}


@pytest.mark.parametrize('image, condition', [
    *((image, condition) for image in DRIVEN
      for condition in ('nothing', 'heartbeats are found late')),
    *(('nano_car_custom', condition) for condition in CONDITIONS)])
def test_all_is_off_33_ms_after_the_last_heartbeat(copy_of, image, condition):
    world, orders, outputs = DRIVEN[image]
    board = copy_of(world, image + '.elf')
    for number in range(ROUNDS):
        drive(board, orders, outputs)
        board.run(0.05 + 0.0037 * number)
        for line in CONDITIONS[condition]:
            board.ask(line)
        if condition.startswith('more'):
            board.send(10 * board.beat)
        board.run(0.04 if condition.startswith('heartbeats') else 0)
        board.beat = b''
        board.run(0.02)         # what is on the line has arrived
        last = board.get('last_rx_time')
        board.run(0.2)          # what was held up has been read
        for output in outputs:
            off, value = board.history(output)[-1]
            assert value == 0 and off - last <= 0.033
            if condition == 'nothing' or 'I2C' in condition:
                assert off - last >= 0.03       # no heartbeat is called lost too early
        board.set(sda_stuck=0, scl_stuck=0)
        board.run(1)


@pytest.mark.parametrize('image', DRIVEN)
def test_a_computer_that_was_suspended_has_to_send_a_new_order(copy_of, image):
    """Its heartbeats alone turn nothing on."""
    world, orders, outputs = DRIVEN[image]
    board = copy_of(world, image + '.elf')
    drive(board, orders, outputs)
    board.beat = b''
    board.run(1)
    known = [board.history(output) for output in outputs]
    board.beat = HEARTBEAT
    board.run(1)
    assert [board.history(output) for output in outputs] == known
    drive(board, orders, outputs)


@pytest.mark.parametrize('image', DRIVEN)
def test_orders_without_heartbeats_turn_nothing_on(copy_of, image):
    world, orders, outputs = DRIVEN[image]
    board = copy_of(world, image + '.elf')
    board.beat = orders
    board.run(0.5)
    assert all(value == 0 for output in outputs for _, value in board.history(output))


# A program that hangs


def sync(board):
    board.call(request(0))


def lift_moves(board):
    sync(board)
    board.send(lift(UP, 200))
    board.until(lambda: board.get('lift_moves'))


def pump(board):
    sync(board)
    assert board.call(function(PUMP, 1)) == OK


def pump_and_door(board):
    pump(board)
    board.send(function(DOOR, 1))
    board.until(lambda: board.get('door'))


CRASHING = {
    **{image: (world, lambda board, orders=orders, outputs=outputs: drive(board, orders, outputs),
               outputs + ['gripper_pwm'] * (image == 'nano_car_custom'))
       for image, (world, orders, outputs) in DRIVEN.items()},
    'ctrl_board': ('ctrl', lift_moves, []),
    'ctrl_board_custom': ('ctrl', pump, ['pump']),
    'Slave': ('ctrl', pump_and_door, ['pump', 'door']),
    'range_imu': ('range', lambda board: None, []),
}


# With interrupts off; and on, where they let the emulated program go on a little.
@pytest.mark.parametrize('hang, most', [('crash', 0.13), ('stall 10', 0.5)])
@pytest.mark.parametrize('image', CRASHING)
def test_the_watchdog_ends_a_program_that_hangs_and_all_is_off(copy_of, image, hang, most):
    world, turn_on, outputs = CRASHING[image]
    for number in range(ROUNDS):
        board = copy_of(world, image + '.elf')
        turn_on(board)
        board.run(0.003 * number)
        board.ask(hang)
        board.beat = b''
        board.until(lambda board=board: board.get('watchdog_resets'), most)
        reset = board.now
        board.run(0.3)
        assert board.get('watchdog_resets') == 1       # it does not bite again
        for output in outputs:
            assert board.history(output)[-2][1] > 0
            off, value = board.history(output)[-1]
            assert value == 0 and off <= reset
        if world == 'ctrl':
            assert board.get('lift_last_step') <= reset
