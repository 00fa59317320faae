"""The Arduino library: its examples as the IDE builds them, and mistakes that do not compile."""

import glob
import json
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
    assert flash < 8000 and ram < 700


@pytest.mark.parametrize('example, at_least', [('Hello', 400), ('Sensor', 400), ('Slave', 150)])
def test_a_sketch_that_announces_nothing_has_no_code_for_it(
        example, at_least, firmware_build, tmp_path):
    sketch = read('%s/examples/%s/%s.ino' % (LIBRARY, example, example))
    rows = re.search(r'const char kRows.*?;\n\n', sketch, re.S).group(0)
    silent = re.sub(r'.*announce\(kRows\);\n', '', sketch.replace(rows, ''))
    text = ''.join(re.findall(r'"(.*)"', rows)).replace('\\n', '\n')
    flash, silent_flash = (size_in_the_ide(each, firmware_build, tmp_path)[0]
                           for each in (sketch, silent))
    print('%s: %d bytes for announcing' % (example, flash - silent_flash - len(text)))
    assert flash - silent_flash - len(text) > at_least


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


def test_the_library_stands_alone():
    """Its folder has what a repository of its own needs, and PlatformIO's file says the same."""
    assert read(LIBRARY + '/LICENSE') == read(os.path.join(FIRMWARE, os.pardir, 'LICENSE'))
    properties = dict(line.split('=', 1) for line in
                      read(LIBRARY + '/library.properties').splitlines())
    found = json.loads(read(LIBRARY + '/library.json'))
    assert (found['name'], found['version'], found['description'], found['headers']) == (
        properties['name'], properties['version'], properties['sentence'],
        properties['includes'].split(','))
    assert '../' not in read(LIBRARY + '/README.md')


def test_the_sketch_of_the_readme_builds(tmp_path):
    code = re.search('```cpp\n(.*?)```', read(LIBRARY + '/README.md'), re.S).group(1)
    source = tmp_path / 'sketch.cpp'
    source.write_text(as_the_ide_makes_it(code), encoding='utf-8')
    check(ON_THE_AVR, str(source))


def test_a_sketch_may_have_names_that_the_headers_use_inside(tmp_path):
    """No header has `using namespace`: a struct Packet of the sketch was ambiguous."""
    inside = set()
    for path in glob.glob(PROTOCOL + '/*.h'):
        assert 'using namespace' not in read(path), path
        inside.update(re.findall(r'^(?:class|struct) (\w+)', read(path), re.M))
    own = sorted(inside - set(keywords()))
    assert 'Packet' in own and 'Announcer' in own
    source = tmp_path / 'sketch.cpp'
    source.write_text(
        '#include <Arduino.h>\n' + ''.join('#include <%s>\n' % name_of(path) for path in sorted(
            glob.glob(PROTOCOL + '/*.h'))) + ''.join(
                'struct %s { uint8_t own; };\n%s a%d = {1};\n' % (name, name, index)
                for index, name in enumerate(own)))
    check(ON_THE_AVR, str(source))


def test_the_library_is_exported_as_a_repository_of_its_own(tmp_path):
    root = os.path.join(FIRMWARE, os.pardir)

    def git(folder, *arguments):
        return subprocess.run(['git', '-C', str(folder), *arguments], check=True,
                              stdout=subprocess.PIPE, universal_newlines=True).stdout
    if subprocess.run(['git', '-C', root, 'rev-parse', 'HEAD'], stdout=subprocess.DEVNULL,
                      stderr=subprocess.DEVNULL).returncode:
        pytest.skip('this is no git checkout')
    program, target = os.path.join(root, 'scripts', 'export_library'), tmp_path / 'library'
    subprocess.run([program, str(target)], check=True, stdout=subprocess.DEVNULL)
    names = git(target, 'ls-tree', '-r', '--name-only', 'HEAD').split()
    assert names == git(root, 'ls-tree', '-r', '--name-only', 'HEAD:firmware/protocol').split()
    assert git(target, 'rev-parse', 'HEAD^{tree}') == git(
        root, 'rev-parse', 'HEAD:firmware/protocol')
    assert git(target, 'status', '--porcelain') == '' and git(target, 'remote') == ''
    assert git(target, 'tag').split() == [re.search(
        '^version=(.*)', git(target, 'show', 'HEAD:library.properties'), re.M).group(1)]
    assert int(git(target, 'rev-list', '--count', 'HEAD')) > 1
    for arguments, status in (([str(target)], 1), ([], 2), (['--wrong'], 2)):
        assert subprocess.run([program, *arguments], stderr=subprocess.DEVNULL).returncode == status


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
#include <rate_limit.h>
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
  using serial_communication::MessageType;
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


PORT_WITH_ROOM = """
  struct Uart : HardwareSerial {
    int room = 63;
    int availableForWrite() override { return room; }
    size_t write(const uint8_t* bytes, size_t size) override {
      waits += int(size) > room;
      sent.append(reinterpret_cast<const char*>(bytes), size);
      return size;
    }
    int waits = 0;
  } uart;
"""


def test_update_takes_at_most_64_bytes_a_call(tmp_path):
    """So that loop() goes on, and the watchdog is served, whatever the line brings."""
    run_on_the_pc(tmp_path, """
  static int commands = 0;
  packets.on_calibration([]() { ++commands; });
  for (int i = 0; i < 100; ++i) received.append("\\x02\\x0c\\0", 3);
  packets.update();
  CHECK(received.size() == 300 - 64 && commands == 21)
  while (!received.empty()) packets.update();
  CHECK(commands == 100)
  for (int i = 0; i < 100; ++i) received.append("\\xa5\\0\\0\\0\\xa5", 5);
  bus.update();
  CHECK(received.size() == 500 - 8 * 5 && sent.size() == 8 * 4)
  while (!received.empty()) bus.update();
  CHECK(sent.size() == 100 * 4)
""")


def test_a_bus_request_in_two_pieces_of_64_bytes_is_not_called_invalid(tmp_path):
    run_on_the_pc(tmp_path, """
  received.assign("\\xa5\\0\\0\\0\\xa5", 5);
  received.append(60, '\\x07');            // noise, which would be INVALID after a silence
  received.append("\\xa5\\0\\0\\0\\xa6", 5);
  received.append("\\xa5\\0\\0\\0\\xa5", 5);
  while (!received.empty()) {
    bus.update();
    ++now_ms;
  }
  now_ms += 100;
  bus.update();
  CHECK(sent == std::string("\\xa5\\0\\0\\xa5\\xa5\\0\\0\\xa5", 8))
""")


def test_requests_that_waited_are_answered_a_few_a_call(tmp_path):
    """Each reply may wait for room in the send buffer, and the watchdog must not bite meanwhile."""
    run_on_the_pc(tmp_path, """
  static bool moving = true;
  bus.on(49, []() { return BusResult::pending(); });
  bus.on_pending([]() { return moving ? BusResult::pending() : BusResult::ok(); });
  received.assign("\\xa5\\0\\0\\0\\xa5" "\\xa5\\0\\x55\\x31\\xc1", 10);
  for (int i = 0; i < 40; ++i) received.append("\\xa5\\0\\0\\0\\xa5", 5);
  while (!received.empty()) bus.update();
  CHECK(sent.size() == 4)
  moving = false;
  now_ms = 1000;
  size_t calls = 0;
  for (size_t before = 0; sent.size() != before; ++calls) {
    before = sent.size();
    bus.update();
    CHECK(sent.size() - before <= 9 * 4)
  }
  CHECK(sent.size() == 4 + 4 + 40 * 4 && calls >= 5)
""")


def test_a_command_of_another_size_is_said_once_a_type_and_second(tmp_path):
    output = run_on_the_pc(tmp_path, PORT_WITH_ROOM + """
  PacketLink link(uart);
  link.on<Force>(48, take_force);
  link.on<Force>(148, take_force);
  const std::string wrong("\\x05\\x30\\x07\\x08\\x09\\0" "\\x03\\x94\\x07\\0", 10);
  for (; now_ms < 5000; ++now_ms) {
    received += wrong;
    link.update();
    if (now_ms == 0) uart.room = 10;               // too little
    if (now_ms == 2500) uart.room = 63;
  }
  CHECK(uart.waits == 0 && taken == 0)
  for (char byte : sent) std::putchar(byte == 0 ? '\\n' : byte);
""")
    texts = [line.lstrip(''.join(map(chr, range(32)))).lstrip('+,)*') for line in
             output.split('\n')]
    long, short = ('command %s bytes, its struct 2' % what for what in ('48 has 3', '148 has 1'))
    assert 3 <= len([line for line in texts if long in line]) <= 4, texts
    assert 3 <= len([line for line in texts if short in line]) <= 4, texts


def test_data_of_any_length_are_sent_and_received(tmp_path):
    run_on_the_pc(tmp_path, """
  static std::string text;
  packets.on(50, [](const uint8_t* data, size_t size) {
    text.assign(reinterpret_cast<const char*>(data), size);
  });
  received.assign("\\x05\\x32" "abc\\0", 6);
  packets.update();
  CHECK(text == "abc" && sent.empty())
  received.assign("\\x02\\x32\\0", 3);
  packets.update();
  CHECK(text.empty())
  received.assign("\\x40\\x32" + std::string(62, 'x') + std::string(1, '\\0'));
  while (!received.empty()) packets.update();
  CHECK(text == std::string(62, 'x'))
  CHECK(packets.send(51, "hello", 5) && sent == std::string("\\x07\\x33hello\\0", 8))
  CHECK(packets.send(51, bytes, 0) && !packets.send(4, bytes, 2) && !packets.send(51, bytes, 64))
  sent.clear();
  CHECK(frames.send(51, "hello", 5) && sent.size() == 11)
  CHECK(!frames.send(0x10, bytes, 10) && !frames.send(0xFF, bytes, 10))
  bus.on(51, [](const uint8_t* data, size_t size) {
    text.assign(reinterpret_cast<const char*>(data), size);
    return BusResult::ok();
  });
  received.assign("\\xa5\\0\\0\\0\\xa5" "\\xa5\\x03\\x55\\x33" "abc\\xa0", 13);
  bus.update();
  CHECK(text == "abc")
""")


# What `header` makes of the row of a text: its last value has any length.
DISPLAY = """
  struct PACKED Display {
    enum : uint16_t { LEAST = 1 };
    uint8_t line;
    char text[16];
  };
  static std::string shown;
"""


def test_a_struct_whose_text_has_any_length_takes_up_to_all_of_it(tmp_path):
    run_on_the_pc(tmp_path, DISPLAY + """
  packets.on<Display>(50, [](const Display& display) {
    shown = char('0' + display.line) + std::string(display.text, strnlen(display.text, 16));
  });
  received.assign("\\x07\\x32\\x02" "late\\0", 8);
  packets.update();
  CHECK(shown == "2late")
  received.assign("\\x03\\x32\\x01\\0", 4);
  packets.update();
  CHECK(shown == "1" && sent.empty())
  received.assign("\\x13\\x32\\x01" + std::string(16, 'x') + std::string(1, '\\0'));
  packets.update();
  CHECK(shown == "1" + std::string(16, 'x'))
  received.assign("\\x14\\x32\\x01" + std::string(17, 'y') + std::string(1, '\\0'));
  packets.update();
  CHECK(shown == "1" + std::string(16, 'x') && sent.find("50 has 18 bytes") != std::string::npos)
""")


def test_a_rate_limit_lets_one_through_a_period(tmp_path):
    run_on_the_pc(tmp_path, """
  RateLimit limit(1000);
  int passed = 0;
  now_ms = 0xFFFFF000;
  for (int i = 0; i < 10000; ++i) passed += limit.passes(uint32_t(now_ms++));
  CHECK(passed == 10)
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
