"""Boards in lock step: each image boots once, and each test has a copy of its own."""
import pytest

import emulated_board
from packets import request


@pytest.fixture(scope='session')
def firmware_build():
    return emulated_board.build_firmware()


@pytest.fixture(scope='session')
def booted(firmware_build):
    """A function: the emulated_board.Booted with these arguments."""
    boards = {}

    def board(*arguments, **options):
        key = arguments, tuple(options.items())
        if key not in boards:
            boards[key] = emulated_board.Booted(firmware_build, *arguments, **options)
        return boards[key]
    yield board
    for each in boards.values():
        each.close()


@pytest.fixture
def copy_of(booted):
    """A function: a copy of the board with these arguments, until the end of the test."""
    copies = []

    def copy(*arguments, **options):
        copies.append(booted(*arguments, **options).copy())
        return copies[-1]
    yield copy
    for each in copies:
        each.close()


@pytest.fixture
def car(copy_of):
    """nano_car, whose IMU is ready."""
    car = copy_of('car')
    yield car
    assert car.get('rx_overruns') == 0


@pytest.fixture
def bus(copy_of):
    """ctrl_board, synchronised."""
    bus = copy_of('ctrl')
    assert bus.call(request(0)) == b'\0'
    yield bus
    assert bus.get('rx_overruns') == 0


@pytest.fixture
def sensors(copy_of):
    """range_imu, all of whose sensors have been started."""
    return copy_of('range', boot=2.5)
