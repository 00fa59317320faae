"""The headers and the sketches with the compilers of other chips; every warning is an error."""

import glob
import os

import pytest

from compilers import ON_THE_AVR, ON_THE_ESP, ON_THE_PC, PROTOCOL, check
from emulated_board import FIRMWARE

COMPILERS = {
    'PC': ON_THE_PC + ['-fsigned-char'],
    'PC, unsigned char': ON_THE_PC + ['-funsigned-char'],
    'AVR': ON_THE_AVR,
    'ESP': ON_THE_ESP,
}
HEADERS = sorted(os.path.basename(path) for path in glob.glob(PROTOCOL + '/*.h'))
ESP_SOURCES = ['range_imu.ino', 'sensors.cpp', 'sensors_esp32.cpp', 'sensors_avr.cpp']


@pytest.mark.parametrize('chip', sorted(COMPILERS))
def test_headers(chip, tmp_path):
    """All at once, in either order, so that none leans on another."""
    headers = [name for name in HEADERS if chip == 'AVR' or not name.startswith('avr_')]
    for order in (headers, headers[::-1]):
        source = tmp_path / 'headers.cpp'
        source.write_text(''.join('#include <%s>\n' % name for name in order))
        check(COMPILERS[chip], str(source))


@pytest.mark.parametrize('source', ESP_SOURCES)
def test_sensor_board_on_the_esp32(source):
    check(ON_THE_ESP, os.path.join(FIRMWARE, 'range_imu', source), '-include', 'Arduino.h')


@pytest.mark.parametrize('seconds', [10, 400, 600])
def test_calibration_of_any_duration(seconds):
    check(ON_THE_AVR, os.path.join(FIRMWARE, 'nano_car', 'imu.cpp'),
          '-DCALIBRATION_SECONDS=%d' % seconds)
