"""What keeps every image and example safe: watchdog, pull-downs, an update() that ends."""

import os
import re
import struct

import pytest

from board_ends import (
    CALIBRATION, GRIPPER, HEARTBEAT, LED, LIFT, OK, PUMP, SETTING, SPEED, STEERING, UP, WARN, Car,
    Frames, Master, drive_until, driving, packet, request,
)
from driven_base import cmd_vel
from emulated_board import FIRMWARE, EmulatedBoard
from test_motor_stop import ROUNDS, print_times
from waiting import again_if_stalled
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


@pytest.mark.parametrize('image', ['Car', 'DiffDrive', 'Slave'])
def test_pull_downs_keep_noise_from_floating_pins(firmware_build, image):
    """In the bootloader, which each opening of the port starts, no pin is driven."""
    world, turn_on = IMAGES[image]
    outputs = {'car': ('motor_pwm', 'bridge_inputs'),
               'diff': ('left_pwm', 'left_inputs', 'right_pwm', 'right_inputs'),
               'ctrl': ('pump', 'door', 'lift_steps', 'pan_steps', 'tilt_steps')}[world]
    with EmulatedBoard(firmware_build, world, image=image + '.elf') as board:
        for pull_downs in (1, 0):
            turn_on(board)
            board.set('pull_downs', pull_downs)
            board.ask('dtr')
            opened = board.time
            values = [[board.get(output)] for output in outputs]

            def the_program_runs():
                if board.time - opened < 0.95:
                    for seen, output in zip(values, outputs):
                        seen.append(board.get(output))
                return board.time - opened > 1.1

            board.wait_until(the_program_runs, 2)
            moved = [len(set(seen)) > 1 for seen in values]
            assert moved == [not pull_downs] * len(outputs), (pull_downs, values)
            # The program turns everything off as it starts, whatever the noise has left.
            for output in outputs[:2] if world == 'ctrl' else outputs:
                assert board.get(output) == 0


def flood(board, port, wanted, seconds, condition=lambda: False):
    """Fill the line for so long, or until a condition; the bytes a second that were received."""
    waiting, start, received = b'', board.time, board.get('rx_bytes')

    def is_over():
        nonlocal waiting
        waiting = waiting or wanted * 20
        try:
            waiting = waiting[os.write(port.fileno(), waiting):]
        except BlockingIOError:
            pass
        return condition() or board.time > start + seconds

    board.wait_until(is_over, 3 * seconds)
    return (board.get('rx_bytes') - received) / (board.time - start)


FLOODS = {
    'unknown lamps': ('nano_car_emulated', packet(LED, b'foo\0')),
    'lamps': ('nano_car_emulated', packet(LED, b'left\0')),
    'steering': ('nano_car_emulated', packet(STEERING, b'\xdc\x05')),
    'speed': ('nano_car_emulated', packet(SPEED, b'\xbc\x02')),
    'commands of another size': ('nano_car_custom', packet(GRIPPER, b'\x01')),
    'calibrations without an IMU': ('Car', packet(CALIBRATION)),
    'settings': ('nano_car_emulated', packet(SETTING, b'\x01\x00\x00') + packet(
        SETTING, b'\x02\xc8\x00') + packet(SETTING, b'\x01\x01\x00') + packet(
            SETTING, b'\x02\xc9\x00') + packet(SETTING, b'\x03\x64')),
}


@pytest.mark.parametrize('what', sorted(FLOODS))
def test_no_flood_of_commands_resets_the_car_or_hides_its_heartbeats(firmware_build, what):
    image, unwanted = FLOODS[what]
    with EmulatedBoard(firmware_build, 'car', image=image + '.elf') as board:
        car = Car(board)
        wanted = driving(700) + unwanted * (100 // len(unwanted))
        flood(board, car.port, wanted, 2, lambda: car.read() and False
              or board.get('motor_pwm') > 0)

        def every_heartbeat_is_read_in_time():
            changes = board.history('motor_pwm')
            rate = flood(board, car.port, wanted, 2, lambda: car.read() and False)
            line_is_full = rate > 0.9 * 11520
            return line_is_full and board.history('motor_pwm') == changes and changes[-1][1] > 0
        assert again_if_stalled(every_heartbeat_is_read_in_time)
        assert board.get('watchdog_resets') == 0
        warnings = [text for kind, text in car.texts() if kind == WARN]
        assert len(warnings) <= 5, warnings    # one a second
        car.port.close()


@pytest.mark.parametrize('image', ['ctrl_board', 'Slave'])
@pytest.mark.parametrize('sent', [
    request(1, 0, bytes(300)) + request(1) * 40, request(0x55, 0x77),
    b'\xa5\x05\x5a\xff\x00' * 9], ids=['ECHO', 'unsupported', 'noise'])
def test_no_flood_of_requests_resets_a_bus_board(firmware_build, image, sent):
    with EmulatedBoard(firmware_build, 'ctrl', image=image + '.elf') as board:
        port = synchronised(board).port
        flood(board, port, sent, 1.5, lambda: port.read(4096) and False)
        assert board.get('watchdog_resets') == 0
