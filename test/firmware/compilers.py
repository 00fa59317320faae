"""The compilers of the chips and of the PC; every warning is an error."""
import os
import subprocess

from emulated_board import FIRMWARE

HERE = os.path.dirname(os.path.abspath(__file__))
STUBS = os.path.join(HERE, 'stubs')
PROTOCOL = os.path.join(FIRMWARE, 'protocol', 'src')
CORE = '/usr/share/arduino/hardware/arduino/avr'
STRICT = ['-Wall', '-Wextra', '-Werror']

ON_THE_PC = ['g++', '-Wcast-align', '-Wshadow', '-I', os.path.join(STUBS, 'esp32')]
ON_THE_AVR = ['avr-g++', '-Os', '-mmcu=atmega328p', '-DF_CPU=16000000L', '-DARDUINO=10819',
              '-DARDUINO_ARCH_AVR', '-I', CORE + '/cores/arduino',
              '-I', CORE + '/variants/eightanaloginputs']
# An ESP8266's: the ESP32's instruction set and alignment, and unsigned char.
ON_THE_ESP = ['xtensa-lx106-elf-g++', '-Wcast-align', '-Wshadow', '-ffreestanding',
              '-DARDUINO_ARCH_ESP32', '-I', os.path.join(STUBS, 'no_libc'),
              '-I', os.path.join(STUBS, 'esp32')]


def run(command, **options):
    """Run a program; return its exit status and all that it printed."""
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                          universal_newlines=True, **options)
    return done.returncode, done.stdout


def check(compiler, path, *options):
    """Check that a file compiles."""
    status, output = run(compiler + ['-std=gnu++11', '-fsyntax-only', *STRICT, '-I', PROTOCOL,
                                     '-x', 'c++', *options, str(path)])
    assert status == 0, output


def for_the_pc(source, program, *options):
    """The command that compiles a file of this folder, under sanitizers."""
    return ['g++', '-std=c++11', '-O1', *STRICT, '-fsanitize=address,undefined',
            '-fno-sanitize-recover=all', *options, '-I', PROTOCOL,
            '-I', os.path.join(STUBS, 'esp32'), os.path.join(HERE, source), '-o', str(program)]
