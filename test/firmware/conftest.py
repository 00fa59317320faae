"""Fixtures of the firmware tests: one build for all of them."""

import subprocess

import pytest

import emulated_board
from board_ends import car_end, frames_end, master_end
from compilers import for_the_pc, run

PROGRAMS = 'protocol_driver', 'library_cases'      # that are compiled for the PC


@pytest.fixture(scope='session')
def firmware_build():
    return emulated_board.build_firmware()


@pytest.fixture(scope='session', autouse=True)
def compilers(tmp_path_factory):
    """(program, its compiler) by name; they run while the boards' tests wait for the boards."""
    folder = tmp_path_factory.mktemp('programs')
    started = {name: (str(folder / name), subprocess.Popen(
        for_the_pc(name + '.cpp', folder / name), stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, universal_newlines=True))
        for name in PROGRAMS}
    yield started
    for _, compiler in started.values():
        compiler.kill()
        compiler.wait()


@pytest.fixture(scope='session')
def built(compilers):
    """A function: the path of a program."""
    def path(name):
        program, compiler = compilers[name]
        if compiler.returncode is None:
            output = compiler.communicate()[0]
            assert compiler.returncode == 0, output
        return program
    return path


@pytest.fixture(scope='session')
def library_case(built):
    """A function that runs a case of library_cases.cpp; returns what it prints."""
    def output(*arguments):
        status, printed = run([built('library_cases'), *map(str, arguments)])
        assert status == 0, printed
        return printed
    return output


@pytest.fixture
def car(firmware_build):
    with car_end(firmware_build) as car:
        car.wait_for_text('IMU ready')
        yield car
        # A board that crashed has lost what arrived until the watchdog's reset.
        assert car.board.get('rx_overruns') == 0 or car.board.get('watchdog_resets') > 0


@pytest.fixture
def master(firmware_build):
    with master_end(firmware_build) as master:
        yield master
        assert master.board.get('rx_overruns') == 0


@pytest.fixture
def bus(master):
    master.sync()
    return master


@pytest.fixture
def sensors(firmware_build):
    with frames_end(firmware_build) as frames:
        frames.board.wait_until(lambda: frames.next()[0][4:] == (0, 0), 3)    # all have started
        yield frames
