"""Fixtures of the firmware tests: one build for all of them."""

import os
import subprocess

import pytest

import emulated_board

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
            os.path.join(emulated_board.FIRMWARE, 'protocol'),
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
