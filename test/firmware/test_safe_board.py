"""What keeps every image and example safe: watchdog, pull-downs, an update() that ends."""

import os
import re
import struct

import pytest

from board_ends import (
    GRIPPER, HEARTBEAT, LIFT, OK, PUMP, UP, Car, Frames, Master, drive_until, packet, request,
)
from driven_base import cmd_vel
from emulated_board import FIRMWARE, EmulatedBoard
from test_motor_stop import ROUNDS, print_times
from wheel import TARGET

DOOR = 0x33    # function of the example Slave


def nothing(board):
    """It has no motor, door or pump."""
    return ()


def sending(board):
    frames = Frames(board)
    frames.forget_a_cut_frame()
    board.wait_until(frames.read, 1)
    return ()


def motor(board):
    car = Car(board)
    drive_until(car, 700, lambda: board.get('motor_pwm') > 0)
    return ('motor_pwm',)


def wheel(board):
    car = Car(board)

    def runs():
        car.port.write(packet(TARGET, struct.pack('<f', 8)) + packet(HEARTBEAT))
        car.read()
        return board.get('motor_pwm') > 0

    board.wait_until(runs, 2)
    return ('motor_pwm',)


def motor_and_gripper(board):
    car = Car(board)

    def runs():
        car.drive(700)
        car.send(GRIPPER, struct.pack('<hB', 1000, 1))
        car.read()
        return board.get('motor_pwm') > 0 and board.get('gripper_pwm') == 255

    board.wait_until(runs, 2)
    return 'motor_pwm', 'gripper_pwm'


def both_motors(board):
    car = Car(board)

    def runs():
        car.port.write(packet(HEARTBEAT) + cmd_vel(0.4, 0.0))
        car.read()
        return board.get('left_pwm') > 0 and board.get('right_pwm') > 0

    board.wait_until(runs, 2)
    return 'left_pwm', 'right_pwm'


def synchronised(board):
    board.wait_until(lambda: board.time > 0.05, 1)
    master = Master(board)
    master.forget()
    master.sync()
    return master


def lift(board):
    moves = board.get('lift_moves')
    synchronised(board).write(request(0x55, LIFT, bytes([UP, 1])) * 20)
    board.wait_until(lambda: board.get('lift_moves') > moves, 2)
    return ()


def pump(board):
    assert synchronised(board).function(PUMP, b'\x01') == OK
    return ('pump',)


def pump_and_door(board):
    pump(board)
    Master(board).write(request(0x55, DOOR, b'\x01'))
    board.wait_until(lambda: board.get('door'), 1)
    return 'pump', 'door'


# The image, its world, and what turns its outputs on.
IMAGES = {
    'nano_car': ('car', motor), 'nano_car_emulated': ('car', motor),
    'nano_car_custom': ('car', motor_and_gripper), 'Car': ('car', motor),
    'Tuning': ('car', wheel),
    'ctrl_board': ('ctrl', lift), 'ctrl_board_slow': ('ctrl', lift),
    'ctrl_board_custom': ('ctrl', pump), 'Slave': ('ctrl', pump_and_door),
    'DiffDrive': ('diff', both_motors),
    'range_imu': ('range', sending), 'Hello': ('car', nothing), 'Sensor': ('range', nothing),
}
WATCHED = sorted(name for name, (_, turn_on) in IMAGES.items() if turn_on is not nothing)


def test_no_image_is_left_out():
    with open(os.path.join(FIRMWARE, 'Makefile'), encoding='utf-8') as file:
        makefile = file.read()
    examples, images = (re.search(r'^%s := (.*)$' % name, makefile, re.M).group(1).split()
                        for name in ('EXAMPLES', 'IMAGES'))
    assert set(images[:-1] + examples) == set(IMAGES)


@pytest.mark.parametrize('image', WATCHED)
def test_a_crash_with_interrupts_off_turns_everything_off(firmware_build, image):
    world, turn_on = IMAGES[image]
    taken = []
    with EmulatedBoard(firmware_build, world, image=image + '.elf') as board:
        for crash in range(1, ROUNDS + 1):
            outputs = turn_on(board)
            board.ask('crash')
            board.wait_until(lambda: board.get('watchdog_resets') == crash, 0.2)
            crashed = board.get('crash_time')
            for output in outputs:
                when, value = board.history(output)[-1]
                assert value == 0
                if when > crashed:    # else heartbeats came late, and the motor was off already
                    taken.append(when - crashed)
            start = board.time
            board.wait_until(lambda: board.time > start + 0.15, 1)    # it does not bite again
            assert board.get('watchdog_resets') == crash
            assert all(board.get(output) == 0 for output in outputs)
            if world == 'ctrl':
                assert board.get('lift_last_step') < crashed + 0.01
        if taken:
            print_times('crash of ' + image, taken)
            assert max(taken) < 0.2
