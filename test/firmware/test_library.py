"""The Arduino library: its examples as the IDE builds them, and mistakes that do not compile."""

import glob
import os
import re
import shutil
import subprocess

import pytest

from compilers import (CORE, HERE, ON_THE_AVR, ON_THE_ESP, PROTOCOL, STRICT, STUBS,
                       check, run)

LIBRARY = os.path.dirname(PROTOCOL)
EXAMPLES = sorted(glob.glob(LIBRARY + '/examples/*/*.ino'))
# What arduino-cli gives the compiler, and every warning an error.
IDE = ['-std=gnu++11', '-fno-exceptions', '-ffunction-sections', '-fdata-sections',
       '-fno-threadsafe-statics', '-flto', *STRICT, '-I', PROTOCOL, '-I', STUBS + '/neopixel']
FUNCTION = re.compile(r'^(?!static const|struct|class|ISR)(\w[\w ]*[ &*]+\w+\([^;{}]*\)) \{', re.M)
OTHER_AVRS = {
    'Mega': ['-mmcu=atmega2560', '-I', CORE + '/variants/mega'],
    'Leonardo': ['-mmcu=atmega32u4', '-DUSB_VID=0x2341', '-DUSB_PID=0x8036', '-I',
                 CORE + '/variants/leonardo'],
}


def read(path):
    with open(path, encoding='utf-8') as file:
        return file.read()


def properties():
    return dict(line.split('=', 1) for line in read(LIBRARY + '/library.properties').splitlines())


def name_of(path):
    return os.path.basename(path)


def as_the_ide_makes_it(sketch):
    """One translation unit: Arduino.h, and prototypes of all functions before the first one."""
    functions = list(FUNCTION.finditer(sketch))
    first = functions[0].start()
    prototypes = ''.join('%s;\n' % function.group(1) for function in functions)
    return '#include <Arduino.h>\n' + sketch[:first] + prototypes + sketch[first:]


def compiles(compiler, folder, sketch):
    """Check that a sketch with this text compiles."""
    (folder / 'sketch.cpp').write_text(as_the_ide_makes_it(sketch), encoding='utf-8')
    check(compiler, str(folder / 'sketch.cpp'))


def size_in_the_ide(sketch, firmware_build, tmp_path):
    """Bytes of flash and of RAM of the sketch with this text."""
    source, image = tmp_path / 'sketch.cpp', str(tmp_path / 'sketch.elf')
    source.write_text(as_the_ide_makes_it(sketch), encoding='utf-8')
    subprocess.run(ON_THE_AVR + IDE + [str(source), '-Wl,--gc-sections', '-fuse-linker-plugin',
                                       os.path.join(firmware_build, 'arduino.a'), '-lm',
                                       '-o', image], check=True)
    sizes = subprocess.run(['avr-size', '-A', image], check=True, stdout=subprocess.PIPE,
                           universal_newlines=True).stdout
    text, data, bss = (int(re.search(r'^\.%s +(\d+)' % part, sizes, re.M).group(1))
                       for part in ('text', 'data', 'bss'))
    return text + data, data + bss


@pytest.mark.parametrize('path', EXAMPLES, ids=name_of)
def test_example_builds_as_in_the_ide(path, firmware_build, tmp_path):
    flash, ram = size_in_the_ide(read(path), firmware_build, tmp_path)
    print('%s: %d bytes of flash, %d of RAM' % (name_of(path), flash, ram))
    most = {'DiffDrive.ino': 13000, 'Tuning.ino': 10500}.get(name_of(path), 8000)
    assert flash < most and ram < 700


COMPILERS = {'ESP32': ON_THE_ESP, **{
    chip: [option for option in ON_THE_AVR[:-2] if option != '-mmcu=atmega328p'] + options
    for chip, options in OTHER_AVRS.items()}}


@pytest.mark.parametrize('chip, example', [
    (chip, example) for chip in COMPILERS for example in ('Hello', 'HelloESP32', 'Sensor')
    if chip == 'ESP32' or example != 'HelloESP32'])
def test_example_builds_for_other_chips(chip, example, tmp_path):
    compiles(COMPILERS[chip], tmp_path, read(f'{LIBRARY}/examples/{example}/{example}.ino'))


def test_library_has_what_the_ide_wants():
    found = properties()
    wanted = {'name', 'version', 'author', 'maintainer', 'sentence', 'paragraph', 'category', 'url',
              'architectures', 'includes'}
    assert set(found) == wanted and all(found.values())
    assert found['category'] == 'Communication'
    for header in found['includes'].split(','):
        assert os.path.exists(os.path.join(PROTOCOL, header))
    for path in EXAMPLES:    # the IDE opens only a sketch with the name of its folder
        assert name_of(path) == os.path.basename(os.path.dirname(path)) + '.ino'


def test_the_sketch_of_the_readme_builds(tmp_path):
    code = re.search('```cpp\n(.*?)```', read(LIBRARY + '/README.md'), re.S).group(1)
    compiles(ON_THE_AVR, tmp_path, code)


@pytest.mark.skipif(not shutil.which('arduino-builder'), reason='arduino-builder is not installed')
@pytest.mark.parametrize('processor', ['atmega328', 'atmega328old'])
def test_arduinos_own_builder_finds_the_library_and_compiles_the_example(processor, tmp_path):
    libraries, hardware = tmp_path / 'libraries', '/usr/share/arduino/hardware'
    libraries.mkdir()
    (libraries / 'SerialCommunicationProtocol').symlink_to(os.path.abspath(LIBRARY))
    (tmp_path / 'build').mkdir()
    status, output = run(
        ['arduino-builder', '-compile', '-hardware', hardware,
         '-hardware', '/usr/share/arduino-builder', '-tools', hardware,
         '-libraries', str(libraries), '-build-path', str(tmp_path / 'build'),
         '-fqbn', f'arduino:avr:nano:cpu={processor}', '-warnings', 'none',
         '-prefs=runtime.tools.avr-gcc.path=/usr',
         '-prefs=tools.ctags.path=/usr/bin', '-prefs=tools.ctags.cmd.path=/usr/bin/arduino-ctags',
         # The core's String wants a macro that the float.h of Debian's avr-gcc hides from C++.
         '-prefs=compiler.cpp.extra_flags=-DDECIMAL_DIG=__DECIMAL_DIG__',
         str(libraries / 'SerialCommunicationProtocol/examples/Hello/Hello.ino')])
    assert status == 0 and 'Sketch uses ' in output, output


# Mistakes: each compiles not at all, or is reported.

WRONG = {
    'pointer': ('const Force* f = 0; packets.send(40, f);', 'a pointer'),
    'array that became a pointer': ('const char* text = "a"; packets.send(40, text);', 'a pointer'),
    'String': ('String text("a"); packets.send(40, text);', 'no String'),
    'unpacked struct': ('struct Wide { uint8_t a; uint32_t b; }; Wide w = {1, 2};'
                        ' packets.send(40, w);', 'has to be PACKED'),
    'unpacked struct in a frame': ('struct Wide { uint8_t a; uint32_t b; }; Wide w = {1, 2};'
                                   ' frames.send(40, w);', 'has to be PACKED'),
    'unpacked command': ('packets.on<Wide>(40, take_wide);', 'has to be PACKED'),
    'function for another struct': ('packets.on<Big>(40, take_force);', 'invalid conversion'),
    'too much for a packet': ('packets.send(40, Big());', 'holds no more'),
    'too much for a command': ('packets.on<Big>(40, take_big);', 'holds no more'),
    'too much for a frame': ('frames.send(40, Big());', 'holds no more'),
    'too much for a reply': ('BusResult::ok(Big());', 'holds no more'),
    'too much to announce': ('static const char text[2050] = ""; packets.announce(text);',
                             'at most 2048 bytes'),
    'announcement whose size is lost': ('const char* text = "a"; frames.announce(text);',
                                        'no matching function'),
    'setting of another type': ('static uint16_t x; static const Setting table[] = {'
                                'SETTING_ENTRY(1, x, float, 0, 0, 1, "", "")};', 'cannot convert'),
    'setting of an unknown type': ('static double x; static const Setting table[] = {'
                                   'SETTING_ENTRY(1, x, double, 0, 0, 1, "", "")};',
                                   'incomplete type'),
    'too many settings': ('static Setting table[17] = {}; packets.settings(table);',
                          'at most 16 settings'),
    'settings whose number is lost': ('const Setting* table = 0; frames.settings(table);',
                                      'no matching function'),
    'unpacked request': ('bus.on<Wide>(40, ask_wide);', 'has to be PACKED'),
}


@pytest.mark.parametrize('statement, reason', WRONG.values(), ids=WRONG)
def test_what_is_wrong_does_not_compile(statement, reason):
    """On the ESP: an AVR aligns nothing, so that there every struct is packed."""
    sketch = os.path.join(HERE, 'library_sketch.h')
    with pytest.raises(AssertionError, match=reason):
        check(ON_THE_ESP, sketch, '-DWRONG=' + statement)


def test_what_is_right_compiles():
    check(ON_THE_ESP, os.path.join(HERE, 'library_sketch.h'))


CASES = re.findall(r'^CASE\((\w+)\)', read(HERE + '/library_cases.cpp'), re.M)


@pytest.mark.parametrize('name', CASES)
def test_on_the_pc(library_case, name):
    assert library_case(name) == ''


@pytest.mark.parametrize('type_', [0, 4, 12, 255])
def test_a_handler_for_a_type_of_the_bridge_itself_is_reported(library_case, type_):
    library_case('a_handler_for_a_type_of_the_bridge_itself_is_reported', type_)


def test_a_command_of_another_size_is_said_once_a_type_and_second(library_case):
    output = library_case('a_command_of_another_size_is_said_once_a_type_and_second')
    for what in '48 has 3', '148 has 1':
        assert 3 <= output.count(f'command {what} bytes, its struct 2') <= 4, output
