"""The headers and the sketches with the compilers of other chips; every warning is an error."""

import glob
import os
import subprocess

import pytest

from emulated_board import FIRMWARE

STUBS = os.path.join(os.path.dirname(os.path.abspath(__file__)), 'stubs')
PROTOCOL = os.path.join(FIRMWARE, 'protocol', 'src')
CORE = '/usr/share/arduino/hardware/arduino/avr'

ON_THE_PC = ['g++', '-Wcast-align', '-Wshadow', '-I', os.path.join(STUBS, 'esp32')]
ON_THE_AVR = ['avr-g++', '-Os', '-mmcu=atmega328p', '-DF_CPU=16000000L', '-DARDUINO=10819',
              '-DARDUINO_ARCH_AVR', '-I', CORE + '/cores/arduino',
              '-I', CORE + '/variants/eightanaloginputs']
# An ESP8266's: the ESP32's instruction set and alignment, and unsigned char.
ON_THE_ESP = ['xtensa-lx106-elf-g++', '-Wcast-align', '-Wshadow', '-ffreestanding',
              '-DARDUINO_ARCH_ESP32', '-I', os.path.join(STUBS, 'no_libc'),
              '-I', os.path.join(STUBS, 'esp32')]

COMPILERS = {
    'PC': ON_THE_PC + ['-fsigned-char'],
    'PC, unsigned char': ON_THE_PC + ['-funsigned-char'],
    'AVR': ON_THE_AVR,
    'ESP': ON_THE_ESP,
}
HEADERS = sorted(os.path.basename(path) for path in glob.glob(PROTOCOL + '/*.h'))
ESP_SOURCES = ['range_imu.ino', 'sensors.cpp', 'sensors_esp32.cpp', 'sensors_avr.cpp']


def check(compiler, path, *options):
    command = compiler + [
        '-std=gnu++11', '-fsyntax-only', '-Wall', '-Wextra', '-Werror', '-I', PROTOCOL,
        '-x', 'c++', *options, path]
    result = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                            universal_newlines=True)
    assert result.returncode == 0, result.stdout


@pytest.mark.parametrize('chip', sorted(COMPILERS))
def test_headers(chip, tmp_path):
    """All at once, in either order, so that none leans on another."""
    headers = [name for name in HEADERS if chip == 'AVR' or not name.startswith('avr_')]
    for order in (headers, headers[::-1]):
        source = tmp_path / 'headers.cpp'
        source.write_text(''.join('#include <%s>\n' % name for name in order))
        check(COMPILERS[chip], str(source))


def test_driver_of_the_headers_with_unsigned_char():
    """It uses every template of the headers."""
    check(COMPILERS['PC, unsigned char'],
          os.path.join(os.path.dirname(STUBS), 'protocol_driver.cpp'))


@pytest.mark.parametrize('source', ESP_SOURCES)
def test_sensor_board_on_the_esp32(source):
    check(ON_THE_ESP, os.path.join(FIRMWARE, 'range_imu', source), '-include', 'Arduino.h')


@pytest.mark.parametrize('seconds', [10, 400, 600])
def test_calibration_of_any_duration(seconds):
    check(ON_THE_AVR, os.path.join(FIRMWARE, 'nano_car', 'imu.cpp'),
          '-DCALIBRATION_SECONDS=%d' % seconds)
