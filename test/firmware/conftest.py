"""Fixtures of the firmware tests: one build for all of them.

FIRMWARE_BUILD names a build directory to use and keep; without it the build goes to a temporary
one.
"""

import os

import pytest

import emulated_board


@pytest.fixture(scope='session')
def firmware_build(tmp_path_factory):
    build = os.environ.get('FIRMWARE_BUILD') or str(tmp_path_factory.mktemp('firmware_build'))
    emulated_board.build_firmware(build)
    return build
