"""The Arduino library: its examples as the IDE builds them, and mistakes that do not compile."""

import glob
import os
import re
import shutil
import subprocess

import pytest

from emulated_board import FIRMWARE
from test_compilers import CORE, ON_THE_AVR, ON_THE_ESP, PROTOCOL, STUBS, check

LIBRARY = os.path.dirname(PROTOCOL)
EXAMPLES = sorted(glob.glob(LIBRARY + '/examples/*/*.ino'))
SKETCHES = sorted(path for board in ('nano_car', 'ctrl_board', 'range_imu')
                  for path in glob.glob(os.path.join(FIRMWARE, board, '*.*')))
# What arduino-cli gives the compiler, and every warning an error.
IDE = ['-std=gnu++11', '-fno-exceptions', '-ffunction-sections', '-fdata-sections',
       '-fno-threadsafe-statics', '-flto', '-Wall', '-Wextra', '-Werror', '-I', PROTOCOL]
FUNCTION = re.compile(r'^(?!static const|struct|class|ISR)(\w[\w ]*[ &*]+\w+\([^;{}]*\)) \{', re.M)
OTHER_AVRS = {
    'Mega': ['-mmcu=atmega2560', '-I', CORE + '/variants/mega'],
    'Leonardo': ['-mmcu=atmega32u4', '-DUSB_VID=0x2341', '-DUSB_PID=0x8036', '-I',
                 CORE + '/variants/leonardo'],
}


def read(path):
    with open(path, encoding='utf-8') as file:
        return file.read()


def name_of(path):
    return os.path.basename(path)


def as_the_ide_makes_it(sketch):
    """One translation unit: Arduino.h, and prototypes of all functions before the first one."""
    functions = list(FUNCTION.finditer(sketch))
    first = functions[0].start()
    prototypes = ''.join('%s;\n' % function.group(1) for function in functions)
    return '#include <Arduino.h>\n' + sketch[:first] + prototypes + sketch[first:]


@pytest.mark.parametrize('path', EXAMPLES, ids=name_of)
def test_example_builds_as_in_the_ide(path, firmware_build, tmp_path):
    source, image = tmp_path / 'sketch.cpp', str(tmp_path / 'sketch.elf')
    source.write_text(as_the_ide_makes_it(read(path)), encoding='utf-8')
    subprocess.run(ON_THE_AVR + IDE + [str(source), '-Wl,--gc-sections', '-fuse-linker-plugin',
                                       os.path.join(firmware_build, 'arduino.a'), '-lm',
                                       '-o', image], check=True)
    sizes = subprocess.run(['avr-size', '-A', image], check=True, stdout=subprocess.PIPE,
                           universal_newlines=True).stdout
    text, data, bss = (int(re.search(r'^\.%s +(\d+)' % part, sizes, re.M).group(1))
                       for part in ('text', 'data', 'bss'))
    print('%s: %d bytes of flash, %d of RAM' % (name_of(path), text + data, data + bss))
    assert text + data < 8000 and data + bss < 700


@pytest.mark.parametrize('chip', sorted(OTHER_AVRS))
@pytest.mark.parametrize('example', ['Hello', 'Sensor'])
def test_example_builds_for_other_avrs(chip, example, tmp_path):
    source = tmp_path / 'sketch.cpp'
    source.write_text(as_the_ide_makes_it(read('%s/examples/%s/%s.ino' % (
        LIBRARY, example, example))), encoding='utf-8')
    compiler = [option for option in ON_THE_AVR
                if option != '-mmcu=atmega328p' and 'variants' not in option]
    subprocess.run(compiler[:-1] + OTHER_AVRS[chip] + IDE + ['-fsyntax-only', str(source)],
                   check=True)


@pytest.mark.parametrize('example', ['Hello', 'HelloESP32', 'Sensor'])
def test_example_builds_for_the_esp32(example, tmp_path):
    source = tmp_path / 'sketch.cpp'
    source.write_text(as_the_ide_makes_it(read('%s/examples/%s/%s.ino' % (
        LIBRARY, example, example))), encoding='utf-8')
    check(ON_THE_ESP, str(source))


def test_hello_is_short():
    assert len(read(LIBRARY + '/examples/Hello/Hello.ino').splitlines()) <= 40


def test_library_has_what_the_ide_wants():
    properties = dict(line.split('=', 1) for line in
                      read(LIBRARY + '/library.properties').splitlines())
    wanted = {'name', 'version', 'author', 'maintainer', 'sentence', 'paragraph', 'category', 'url',
              'architectures', 'includes'}
    assert set(properties) == wanted and all(properties.values())
    assert properties['category'] == 'Communication'
    for header in properties['includes'].split(','):
        assert os.path.exists(os.path.join(PROTOCOL, header))
    for path in EXAMPLES:    # the IDE opens only a sketch with the name of its folder
        assert name_of(path) == os.path.basename(os.path.dirname(path)) + '.ino'


def keywords():
    lines = [line for line in read(LIBRARY + '/keywords.txt').splitlines()
             if line and not line.startswith('#')]
    assert all(re.match(r'\w+\t(KEYWORD[12]|LITERAL1)$', line) for line in lines)
    return [line.split('\t')[0] for line in lines]


def test_keywords_are_in_the_headers():
    headers = ' '.join(read(path) for path in glob.glob(PROTOCOL + '/*.h'))
    assert [word for word in keywords() if not re.search(r'\b%s\b' % word, headers)] == []


def test_examples_show_what_the_reference_sketches_use():
    """Every keyword that a sketch uses, and every header."""
    shown = ' '.join(read(path) for path in EXAMPLES)
    used = ' '.join(read(path) for path in SKETCHES)
    headers = [name_of(path) for path in glob.glob(PROTOCOL + '/*.h')]
    assert set(re.findall(r'#include <(\w+\.h)>', used)) & set(headers) <= set(
        re.findall(r'#include <(\w+\.h)>', shown))
    missing = [word for word in keywords() if re.search(r'\b%s\b' % word, used)
               and not re.search(r'\b%s\b' % word, shown)]
    assert missing == []


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
    'unpacked request': ('bus.on<Wide>(40, ask_wide);', 'has to be PACKED'),
}
SKETCH = """
#include <Arduino.h>
#include <BusSlave.h>
#include <FrameLink.h>
#include <PacketLink.h>
struct PACKED Force { int16_t centinewtons; };
struct PACKED Big { uint8_t a[64]; };
struct Wide { uint8_t a; uint32_t b; };
PacketLink packets(Serial);
FrameLink frames(Serial);
BusSlave bus(Serial);
int taken = 0;
void take_force(const Force& force) { taken = force.centinewtons; }
void take_big(const Big&) {}
void take_wide(const Wide&) {}
BusResult ask_force(const Force& force) { return BusResult::ok(force); }
BusResult ask_wide(const Wide&) { return BusResult::ok(); }
bool all() {
  const Force force = {1};
  %s
  return packets.send(32, force) && frames.send(32, force) && packets.on<Force>(48, take_force) &&
         bus.on<Force>(48, ask_force);
}
"""


@pytest.mark.parametrize('wrong', sorted(WRONG))
def test_what_is_wrong_does_not_compile(wrong, tmp_path):
    """On the ESP: an AVR aligns nothing, so that there every struct is packed."""
    statement, reason = WRONG[wrong]
    source = tmp_path / 'sketch.cpp'
    source.write_text(SKETCH % '')
    check(ON_THE_ESP, str(source))
    source.write_text(SKETCH % statement)
    with pytest.raises(AssertionError, match=reason):
        check(ON_THE_ESP, str(source))


PC = """
#include <cstdio>
#include <string>
HardwareSerial Serial;
size_t room = 1000;
unsigned long now_ms = 0;
std::string received, sent;
unsigned long millis() { return now_ms; }
int HardwareSerial::available() { return int(received.size()); }
int HardwareSerial::read() {
  const uint8_t byte = uint8_t(received[0]);
  received.erase(0, 1);
  return byte;
}
size_t HardwareSerial::write(uint8_t byte) { return write(&byte, 1); }
size_t HardwareSerial::write(const uint8_t* bytes, size_t size) {
  if (size > room) size = room;
  sent.append(reinterpret_cast<const char*>(bytes), size);
  return size;
}
#define CHECK(condition) if (!(condition)) { std::printf("%%s\\n", #condition); return 1; }
int main() {
  const Force force = {0x0102};
  uint8_t bytes[64] = {0};
  (void)bytes;
  %s
  return 0;
}
"""


def run_on_the_pc(tmp_path, body):
    """Run a main() with this body; returns what it prints."""
    source, program = tmp_path / 'sketch.cpp', str(tmp_path / 'sketch')
    source.write_text(SKETCH % '' + PC % body)
    subprocess.run(['g++', '-std=c++11', '-fsanitize=address,undefined', '-I', PROTOCOL,
                    '-I', os.path.join(STUBS, 'esp32'), str(source), '-o', program], check=True)
    result = subprocess.run([program], stdout=subprocess.PIPE, universal_newlines=True)
    assert result.returncode == 0, result.stdout
    return result.stdout


def test_send_returns_whether_all_of_it_was_sent(tmp_path):
    run_on_the_pc(tmp_path, """
  CHECK(packets.send(32, force) && sent.size() == 5)
  CHECK(frames.send(32, force))
  room = 4;
  CHECK(!packets.send(32, force) && !frames.send(32, force))
  room = 1000;
  sent.clear();
  CHECK(!packets.send(4, force) && !packets.send(255, force))        // types of the bridge itself
  CHECK(!frames.send(0x10, force) && !frames.send(0x01, force) && !frames.send(0xFF, force))
  CHECK(!packets.send(MessageType::Imu, bytes, 64))
  CHECK(!frames.send(40, bytes, 33))
  CHECK(sent.empty())
  CHECK(packets.send(MessageType::Imu, bytes, 63) && frames.send(40, bytes, 32))
  CHECK(packets.send(MessageType::Info, bytes, 64))                  // text is cut
""")


def test_reply_that_is_full_takes_no_more(tmp_path):
    run_on_the_pc(tmp_path, """
  BusResult result = BusResult::ok();
  for (int i = 0; i < 8; ++i) CHECK(result.append_uint16(7))
  CHECK(!result.append_uint16(7) && result.size == 16)
""")


def test_a_handler_too_many_is_reported_to_the_bridge(tmp_path):
    run_on_the_pc(tmp_path, """
  for (uint8_t type = 40; type < 48; ++type) CHECK(packets.on<Force>(type, take_force))
  packets.update();
  CHECK(sent.empty())
  CHECK(!packets.on<Force>(48, take_force))
  packets.update();
  CHECK(sent.find("too many") != std::string::npos)
  sent.clear();
  packets.update();
  CHECK(sent.empty())
  for (uint8_t cmd2 = 40; cmd2 < 48; ++cmd2) CHECK(bus.on<Force>(cmd2, ask_force))
  CHECK(!bus.on<Force>(48, ask_force))
""")


def test_a_second_handler_of_a_type_is_reported(tmp_path):
    run_on_the_pc(tmp_path, """
  CHECK(packets.on<Force>(48, take_force) && !packets.on<Force>(48, take_force))
  packets.update();
  CHECK(sent.find("twice") != std::string::npos)
  CHECK(bus.on<Force>(48, ask_force) && !bus.on<Force>(48, ask_force))
  CHECK(!bus.on<Force>(255, ask_force))
""")


def test_bus_functions_answer(tmp_path):
    run_on_the_pc(tmp_path, """
  static bool moving = false;
  static int stops = 0;
  bus.on<Force>(48, ask_force);
  bus.on(49, []() { moving = true; return BusResult::pending(); });
  // Request and reply are frames without their checksum.
  const auto frame = [](std::string bytes) {
    uint8_t checksum = 0;
    for (char byte : bytes) checksum ^= uint8_t(byte);
    return bytes.empty() ? bytes : bytes + char(checksum);
  };
  const auto answers = [&](const std::string& request, const std::string& reply) {
    sent.clear();
    received = frame(request);
    bus.update();
    return sent == frame(reply);
  };
  const std::string sync("\\xa5\\0\\0\\0", 4), move("\\xa5\\0\\x55\\x31", 4);
  const std::string stop("\\xa5\\0\\x55\\x2f", 4), ok("\\xa5\\0\\x02", 3);
  const std::string unsupported("\\xa5\\x02\\x03\\0\\x80", 5);
  const std::string malformed("\\xa5\\x02\\x03\\x01\\x80"), failed("\\xa5\\x02\\x03\\x02\\x80");
  CHECK(answers(sync, std::string("\\xa5\\0\\0", 3)))
  CHECK(answers("\\xa5\\x02\\x55\\x30\\x07\\x08", "\\xa5\\x02\\x02\\x07\\x08"))
  CHECK(answers("\\xa5\\x01\\x55\\x30\\x07", malformed))
  CHECK(answers(stop, unsupported))
  bus.on_stop([]() { ++stops; moving = false; });
  CHECK(answers(stop, ok) && stops == 0)
  CHECK(answers(move, failed))                                        // there is no on_pending
  bus.on_pending([]() {
    return moving ? BusResult::pending() : BusResult::failed(kErrorOperation);
  });
  CHECK(answers(move, "") && answers(sync, ""))
  sent.clear();
  received = frame(stop);
  bus.update();
  CHECK(sent == frame(failed) + frame(ok) && stops == 1)              // the SYNC was dropped
""")


@pytest.mark.parametrize('type_', [0, 4, 12, 255])
def test_a_handler_for_a_type_of_the_bridge_itself_is_reported(tmp_path, type_):
    run_on_the_pc(tmp_path, """
  CHECK(!packets.on<Force>(%d, take_force))
  packets.update();
  CHECK(sent.find("13 ... 254") != std::string::npos)
""" % type_)


def test_commands_reach_their_functions(tmp_path):
    run_on_the_pc(tmp_path, """
  static int speed = 0, pulse = 0, calibrations = 0;
  static std::string led;
  packets.on<Force>(48, take_force);
  received.assign("\\x05\\x30\\x02\\x01\\x00", 5);
  packets.update();
  CHECK(taken == 0)                                            // another length
  received.assign("\\x04\\x30\\x02\\x01\\x00" "\\x04\\x04\\x90\\x01\\x00", 10);
  packets.update();
  CHECK(taken == 0x0102)
  packets.on_speed([](int16_t value) { speed = value; });
  packets.on_steering([](uint16_t value) { pulse = value; });
  packets.on_led([](const char* text) { led = text; });
  packets.on_calibration([]() { ++calibrations; });
  received.assign("\\x04\\x04\\x18\\xf0\\x00" "\\x04\\x05\\xdc\\x05\\x00" "\\x06\\x06left\\x00"
                  "\\x02\\x0c\\x00", 20);
  packets.update();
  CHECK(speed == -1000 && pulse == 1500 && led == "left" && calibrations == 1)
  now_ms = 70;
  CHECK(packets.heartbeat_age() == 0xFFFFFFFF)
  received.assign("\\x02\\x0b\\x00", 3);
  packets.update();
  now_ms = 95;
  CHECK(packets.heartbeat_age() == 25)
  now_ms += 60001;
  packets.update();
  now_ms = 70 + 0x100000000;
  CHECK(packets.heartbeat_age() == 0xFFFFFFFF)
""")


# Building and flashing

def make(*arguments, **environment):
    return subprocess.run(['make', '-C', FIRMWARE] + list(arguments), stdout=subprocess.PIPE,
                          stderr=subprocess.STDOUT, universal_newlines=True,
                          env=dict(os.environ, **environment))


@pytest.fixture
def bare_path(tmp_path):
    """A folder with make and a shell, and no compiler."""
    folder = tmp_path / 'bin'
    folder.mkdir()
    for program in ('make', 'sh', 'mkdir', 'test', 'rm'):
        (folder / program).symlink_to(shutil.which(program))
    return str(folder)


def test_flash_names_what_is_missing(bare_path):
    result = make('flash', 'BOARD=Hello', 'ARDUINO=/nowhere', PATH=bare_path)
    assert result.returncode != 0
    for line in ('avr-g++ is missing: sudo apt install gcc-avr avr-libc',
                 '/nowhere/cores/arduino is missing: sudo apt install arduino-core-avr',
                 'avrdude is missing: sudo apt install avrdude'):
        assert line in result.stdout
    for program in ('avr-g++', 'avrdude'):
        os.symlink('/bin/true', os.path.join(bare_path, program))
    assert 'is missing' not in make('toolchain', PATH=bare_path).stdout
    assert 'BOARD=Helo: there are nano_car ' in make('flash', 'BOARD=Helo').stdout


def test_a_path_with_a_space_builds_or_is_one_line(tmp_path):
    folder = tmp_path / 'a clone'
    shutil.copytree(FIRMWARE, str(folder / 'firmware'), ignore=shutil.ignore_patterns('build'))
    (folder / 'scripts').mkdir()
    shutil.copy(os.path.join(FIRMWARE, os.pardir, 'scripts', 'avr_board'), str(folder / 'scripts'))
    dry_run = dict(os.environ, MAKEFLAGS='n')

    def run(*command, **environment):
        return subprocess.run([str(each) for each in command], stdout=subprocess.PIPE,
                              stderr=subprocess.STDOUT, universal_newlines=True,
                              env=dict(dry_run, **environment))
    result = run('make', '-C', folder / 'firmware')
    assert result.returncode == 0 and ' -o build/nano_car.elf' in result.stdout, result.stdout
    result = run(folder / 'scripts' / 'avr_board', 'build')
    log = (folder / 'build' / 'firmware' / 'make.log').read_text()
    assert result.returncode == 0 and ' -o ../build/firmware/nano_car.elf' in log, log
    result = run('make', '-C', folder / 'firmware', 'BUILD=/tmp/a folder')
    assert 'BUILD=/tmp/a folder: make cannot use a path with a space.  Stop.' in result.stdout
    elsewhere = tmp_path / 'a folder'
    result = run(folder / 'scripts' / 'avr_board', 'build', FIRMWARE_BUILD=str(elsewhere))
    assert result.returncode == 1
    assert result.stdout == 'avr_board: make cannot use a path with a space: set FIRMWARE_BUILD ' \
        f'to a folder without one, not {elsewhere}\n'


def test_no_program_that_is_built_has_the_name_of_a_script(firmware_build):
    """rosrun looks for its programs everywhere below the package."""
    built = {name for _, _, names in os.walk(firmware_build) for name in names}
    assert 'avr_emulator' in built
    assert built & set(os.listdir(os.path.join(FIRMWARE, os.pardir, 'scripts'))) == set()
