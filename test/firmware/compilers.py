"""The compilers of the chips and of the PC; every warning is an error."""
import os
import subprocess

from emulated_board import FIRMWARE

HERE = os.path.dirname(os.path.abspath(__file__))
STUBS = os.path.join(HERE, 'stubs')
LIBRARY = os.path.join(FIRMWARE, 'PacketLink')
HEADERS = os.path.join(LIBRARY, 'src')
CORE = '/usr/share/arduino/hardware/arduino/avr'
STRICT = ['-Wall', '-Wextra', '-Werror']

ON_THE_PC = ['g++', '-Wcast-align', '-Wshadow', '-I', os.path.join(STUBS, 'esp32')]
# An ESP8266's: the ESP32's instruction set and alignment, and unsigned char.
ON_THE_ESP = ['xtensa-lx106-elf-g++', '-Wcast-align', '-Wshadow', '-ffreestanding',
              '-DARDUINO_ARCH_ESP32', '-I', os.path.join(STUBS, 'no_libc'),
              '-I', os.path.join(STUBS, 'esp32')]


def on_the_avr(chip='atmega328p', variant='eightanaloginputs'):
    return ['avr-g++', '-Os', '-mmcu=' + chip, '-DF_CPU=16000000L', '-DARDUINO=10819',
            '-DARDUINO_ARCH_AVR', '-I', f'{CORE}/cores/arduino',
            '-I', f'{CORE}/variants/{variant}']


def read(path):
    with open(path, encoding='utf-8') as file:
        return file.read()


def run(command, **options):
    """Run a program; return its exit status and all that it printed."""
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                          universal_newlines=True, **options)
    return done.returncode, done.stdout


def check(compiler, path, *options):
    """Check that a file compiles."""
    status, output = run(compiler + ['-std=gnu++11', '-fsyntax-only', *STRICT, '-I', HEADERS,
                                     '-x', 'c++', *options, str(path)])
    assert status == 0, output


def program(path, *sources):
    """Compile a program for the PC, with the stubs of an ESP32's core, under sanitizers."""
    status, output = run(
        ['g++', '-std=gnu++11', '-O0', '-funsigned-char', '-fsanitize=address,undefined',
         '-fno-sanitize-recover=all', '-DARDUINO_ARCH_ESP32', '-DARDUINO=10819', *STRICT,
         '-I', HEADERS, '-I', os.path.join(STUBS, 'esp32'), '-include', 'Arduino.h',
         '-x', 'c++', *sources, '-o', str(path)])
    assert status == 0, output
    return str(path)
