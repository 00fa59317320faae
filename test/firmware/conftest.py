"""Fixtures of the firmware tests: one build for all of them."""

import os
import subprocess

import pytest

import emulated_board
from board_ends import Car, Frames, Master
from emulated_board import EmulatedBoard

HERE = os.path.dirname(os.path.abspath(__file__))


@pytest.fixture(scope='session')
def firmware_build():
    return emulated_board.build_firmware()


@pytest.fixture(scope='session', autouse=True)
def protocol_driver(tmp_path_factory):
    """The headers' driver, and its compiler, which runs while the boards' tests wait for them."""
    path = str(tmp_path_factory.mktemp('driver') / 'protocol_driver')
    with subprocess.Popen(
        [
            'g++',
            '-std=c++11',
            '-O1',
            '-Wall',
            '-Wextra',
            '-Werror',
            '-fsanitize=address,undefined',
            '-fno-sanitize-recover=all',
            '-I',
            os.path.join(emulated_board.FIRMWARE, 'protocol', 'src'),
            os.path.join(HERE, 'protocol_driver.cpp'),
            '-o',
            path,
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        universal_newlines=True,
    ) as compiler:
        yield path, compiler
        compiler.kill()


@pytest.fixture
def car(firmware_build):
    with EmulatedBoard(firmware_build, 'car') as board:
        car = Car(board)
        car.wait_for_text('IMU ready')
        yield car
        # A board that crashed has lost what arrived until the watchdog's reset.
        assert board.get('rx_overruns') == 0 or board.get('watchdog_resets') > 0
        car.port.close()


@pytest.fixture
def master(firmware_build):
    with EmulatedBoard(firmware_build, 'ctrl') as board:
        board.wait_until(lambda: board.time > 0.05, 1)
        master = Master(board)
        yield master
        assert board.get('rx_overruns') == 0
        master.port.close()


@pytest.fixture
def bus(master):
    master.sync()
    return master


@pytest.fixture
def sensors(firmware_build):
    with EmulatedBoard(firmware_build, 'range') as board:
        frames = Frames(board)
        board.wait_until(lambda: frames.next()[0][4:] == (0, 0), 3)    # all sensors have started
        yield frames
        frames.port.close()
