"""The library's examples, and a sketch of one's own: built as the IDE builds them, and run."""
import glob
import os
import re
import shutil
import struct

import pytest
from by_definition import TIME, arduino_packet

from compilers import HERE, LIBRARY, ON_THE_ESP, STUBS, check, on_the_avr, read, run
from emulated_board import FIRMWARE

OUT, IN = 32, 33      # the types of their rows
EXAMPLES = sorted(os.path.basename(path) for path in glob.glob(LIBRARY + '/examples/*'))
# Those that a reader flashes with the Makefile are built with all images.
IN_THE_MAKEFILE = 'Car', 'DiffDrive', 'Hello', 'Sensor', 'Slave', 'Tuning'


def path_of(example):
    return f'{LIBRARY}/examples/{example}/{example}.ino'


def make(firmware_build, folder, **options):
    """Build a sketch, given by a path from this folder; return what is printed."""
    status, output = run(
        ['make', '-C', FIRMWARE, 'BUILD=' + firmware_build, 'SKETCH=' + folder,
         'WARNINGS=-Wall -Wextra -Werror', *map('='.join, options.items())],
        cwd=HERE, env=dict(os.environ, PWD=HERE))
    assert status == 0, output
    return output


def built(copy_of, firmware_build, example):
    make(firmware_build, path_of(example).rpartition('/')[0])
    return copy_of('pins', f'sketches/{example}.elf')


@pytest.mark.parametrize('example', EXAMPLES)
def test_an_example_builds_as_in_the_ide_and_fits(example, firmware_build):
    if example not in IN_THE_MAKEFILE:
        make(firmware_build, path_of(example).rpartition('/')[0],
             LIBRARIES=os.path.join(STUBS, 'neopixel'))
    elf = f'{firmware_build}/{"" if example in IN_THE_MAKEFILE else "sketches/"}{example}.elf'
    text, data, bss, *_ = map(int, run(['avr-size', elf])[1].splitlines()[1].split()[:3])
    assert text + data < (14000 if example == 'DiffDrive' else 11000) and data + bss < 700


@pytest.mark.parametrize('options', [
    ON_THE_ESP, on_the_avr('atmega2560', 'mega'),
    on_the_avr('atmega32u4', 'leonardo') + ['-DUSB_VID=0x2341', '-DUSB_PID=0x8036']],
    ids=['ESP32', 'Mega', 'Leonardo'])
def test_examples_for_any_chip_build_for_others(options):
    for example in 'Hello', 'Sensor':
        check(options, path_of(example), '-include', 'Arduino.h')


def test_the_sketch_of_the_readme_builds(tmp_path):
    code = re.search('```cpp\n(.*?)```', read(LIBRARY + '/README.md'), re.S).group(1)
    (tmp_path / 'readme.ino').write_text(code)
    check(on_the_avr(), tmp_path / 'readme.ino', '-include', 'Arduino.h')


# What they do


def test_a_button_is_sent_when_it_is_pressed_and_once_a_second(copy_of, firmware_build):
    board = built(copy_of, firmware_build, 'Button')
    for level in 0, 1, 0:
        board.set(d2=level)
        board.forget()
        board.run(0.019)        # it might bounce
        assert board.seen(OUT) == []
        board.run(0.01)
        assert board.seen(OUT) == [bytes([not level])]
    board.forget()
    board.run(2.5)
    assert board.seen(OUT) == [b'\1'] * 2


def test_a_sonar_measures_the_echo_of_each_pulse(copy_of, firmware_build):
    board = built(copy_of, firmware_build, 'Sonar')
    assert board.next(OUT, 3)[1:] == [b'\xff\xff'] * 2     # no echo
    board.set(d2=1)
    board.run(0.01)
    board.set(d2=0)
    assert struct.unpack('<H', board.next(OUT)[0])[0] == pytest.approx(1715, abs=60)
    board.forget()
    board.run(0.5)
    for frame in board.received:        # the time of a pulse, with the pulse
        if frame.type == TIME:
            assert 0 < frame.at - struct.unpack('<I', frame.data[:4])[0] * 1e-6 < 0.005


def test_a_servo_has_no_pulses_before_the_first_command(copy_of, firmware_build):
    board = built(copy_of, firmware_build, 'ServoArm')
    assert board.get('pwm9') == 0
    for angle, us in (0, 1500), (90, 2400), (-90, 600), (120, 2400):
        board.send(arduino_packet(IN, struct.pack('<h', 100 * angle)))
        board.run(0.02)
        # The low byte of the match, in half microseconds.
        assert board.get('pwm9') == (2 * us - 1) % 256


# A sketch of one's own


def test_a_sketch_of_ones_own_is_built_and_its_pins_are_driven_and_read(copy_of, firmware_build):
    assert 'sketches/own.elf' in make(firmware_build, 'own')
    assert os.path.exists(firmware_build + '/sketches/own.hex')
    board = copy_of('pins', 'sketches/own.elf')
    for level in 1, 0, 1:
        board.set(d4=level)
        board.run(0.01)
        assert board.get('d5') == board.get('d4') == level
    for level, duty in (0, 0), (-1, 100):       # the pull-up of pin 6
        board.set(d6=level)
        board.run(0.01)
        assert board.get('pwm9') == duty
    for raw in 512, 7, 0, 511:
        board.set(a0=raw)
        assert board.next(OUT, 2)[1] == struct.pack('<H', 2 * raw)


@pytest.mark.skipif(not shutil.which('arduino-builder'), reason='arduino-builder is not installed')
def test_arduinos_own_builder_finds_the_library_and_compiles_an_example(tmp_path):
    libraries, hardware = tmp_path / 'libraries', '/usr/share/arduino/hardware'
    libraries.mkdir()
    (libraries / 'PacketLink').symlink_to(os.path.abspath(LIBRARY))
    (tmp_path / 'build').mkdir()
    status, output = run(
        ['arduino-builder', '-compile', '-hardware', hardware,
         '-hardware', '/usr/share/arduino-builder', '-tools', hardware,
         '-libraries', str(libraries), '-build-path', str(tmp_path / 'build'),
         '-fqbn', 'arduino:avr:nano:cpu=atmega328', '-warnings', 'none',
         '-prefs=runtime.tools.avr-gcc.path=/usr',
         '-prefs=tools.ctags.path=/usr/bin', '-prefs=tools.ctags.cmd.path=/usr/bin/arduino-ctags',
         # The core's String wants a macro that the float.h of Debian's avr-gcc hides from C++.
         '-prefs=compiler.cpp.extra_flags=-DDECIMAL_DIG=__DECIMAL_DIG__', path_of('Hello')])
    assert status == 0 and 'Sketch uses ' in output, output
