"""A header that `header` made, in a sketch: compiled for two chips, and run on the computer."""
import os
import subprocess
import sys

import pytest
from by_definition import cobs_encode

import emulated_board
from serial_communication.boards.arduino import custom_messages
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.config_file import read_parameters
from serial_communication.framing.announcement import TYPE, Assembly, read_announcement
from test_compilers import ON_THE_AVR, ON_THE_ESP, PROTOCOL, STUBS, check

ROOT = os.path.dirname(emulated_board.FIRMWARE)
EXAMPLES = os.path.join(ROOT, 'config', 'custom_messages.yaml')
HEADER = [sys.executable, os.path.join(ROOT, 'scripts', 'header')]
CHIPS = {'AVR': ON_THE_AVR, 'ESP': ON_THE_ESP}
SKETCH = '''
#include <Arduino.h>
#include <PacketLink.h>

#define FIRMWARE_NAME "my_robot"
#define FIRMWARE_VERSION "1.0"
#include "my_robot.h"

PacketLink bridge(Serial);

void handle_gripper(const Gripper& gripper) {
  Force force;
  force.data = gripper.x;
  bridge.send(Force::TYPE, force);
  const LineSensors<2> line = {{uint16_t(gripper.x), gripper.z}};
  bridge.send(line.TYPE, line);
  const MagneticField field = {1, -1, gripper.x, 258};
  bridge.send(field.TYPE, field);
}

void setup() {
  bridge.on<Gripper>(Gripper::TYPE, handle_gripper);
  bridge.announce(kAnnouncement);
}

void loop() { bridge.update(); }
'''
STDIO = '''
#include <cstdio>
HardwareSerial Serial;
static unsigned long now_ms = 0;
unsigned long millis() { return now_ms; }
int HardwareSerial::available() { return ungetc(getchar(), stdin) != EOF; }
int HardwareSerial::read() { return getchar(); }
size_t HardwareSerial::write(uint8_t byte) { return write(&byte, 1); }
size_t HardwareSerial::write(const uint8_t* bytes, size_t size) {
  return fwrite(bytes, 1, size, stdout);
}
int main() {
  setup();
  while (Serial.available()) loop();
  for (; now_ms < 200000; ++now_ms) loop();
}
'''


@pytest.fixture(scope='module')
def sketch(tmp_path_factory):
    """A folder with a sketch, and the header that it includes."""
    folder = tmp_path_factory.mktemp('sketch')
    (folder / 'my_robot.h').write_bytes(subprocess.check_output(HEADER + [EXAMPLES, 'arduino']))
    (folder / 'sketch.cpp').write_text(SKETCH)
    (folder / 'program.cpp').write_text(SKETCH + STDIO)
    return folder


@pytest.mark.parametrize('chip', sorted(CHIPS))
@pytest.mark.parametrize('link', ['arduino', 'mcu', 'bus'])
def test_the_header_of_every_example_compiles(sketch, link, chip):
    header = sketch / f'{link}.h'
    header.write_bytes(subprocess.check_output(HEADER + [EXAMPLES, link]))
    source = sketch / f'{link}.cpp'
    source.write_text(f'#include "{link}.h"\n')
    check(CHIPS[chip], str(source))


@pytest.mark.parametrize('chip', sorted(CHIPS))
def test_a_sketch_compiles(sketch, chip):
    check(CHIPS[chip], str(sketch / 'sketch.cpp'))


def test_a_sketch_exchanges_values_with_the_bridge_and_announces_its_rows(sketch):
    program = str(sketch / 'program')
    done = subprocess.run(
        ['g++', '-std=c++11', '-Wall', '-Wextra', '-Werror', '-fsanitize=undefined',
         '-fno-sanitize-recover=all', '-I', PROTOCOL, '-I', os.path.join(STUBS, 'esp32'),
         str(sketch / 'program.cpp'), '-o', program],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, encoding='utf-8')
    assert done.returncode == 0, done.stdout
    kinds = {custom.name: custom.kind for custom in custom_messages(
        read_parameters(EXAMPLES)['arduino']['messages'])}
    command = kinds['gripper'](12.3, 0.5)
    sent = subprocess.run([program], input=arduino.encode(command), stdout=subprocess.PIPE,
                          check=True).stdout
    frames = arduino.Decoder(messages=kinds.values()).feed(sent)
    assert [frame.text for frame in frames if frame.type != TYPE] == [
        'force data=1.23', 'line_sensors data=[123 128]',
        'magnetic_field magnetic_field.x=-1.5e-07 magnetic_field.y=1.845e-05 '
        'magnetic_field.z=3.87e-05']
    assembly = Assembly()
    text, = filter(None, [assembly.take(frame.message) for frame in frames if frame.type == TYPE])
    assert read_announcement(text) == (
        'my_robot 1.0', read_parameters(EXAMPLES)['arduino']['messages'], [])


DISPLAY = '''
#include <Arduino.h>
#include <PacketLink.h>
#include "display.h"

PacketLink bridge(Serial);

void handle_display(const Display<16>& display) {
  uint8_t size = 0;
  while (size < sizeof display.data && display.data[size] != 0) ++size;
  bridge.send(60, display.data, size);
}

void setup() { bridge.on<Display<16>>(Display<16>::TYPE, handle_display); }

void loop() { bridge.update(); }
'''


def test_a_command_with_a_text_takes_up_to_the_characters_of_its_struct(sketch):
    """The sketch sends back what it is to show."""
    (sketch / 'display.yaml').write_text('arduino: {messages: {display: {type: 50, direction: '
                                         'to_board, ros_type: std_msgs/String, layout: "<s", '
                                         'fields: [data]}}}')
    (sketch / 'display.h').write_bytes(
        subprocess.check_output(HEADER + [str(sketch / 'display.yaml')]))
    (sketch / 'display.cpp').write_text(DISPLAY)
    for compiler in CHIPS.values():
        check(compiler, str(sketch / 'display.cpp'))
    (sketch / 'display_program.cpp').write_text(DISPLAY + STDIO)
    program = str(sketch / 'display_program')
    subprocess.run(['g++', '-std=c++11', '-fsanitize=address,undefined', '-I', PROTOCOL, '-I',
                    os.path.join(STUBS, 'esp32'), str(sketch / 'display_program.cpp'), '-o',
                    program], check=True)
    texts = [b'', b'late', b'x' * 16, b'y' * 17]
    packets = b''.join(cobs_encode(b'\x32' + text) + b'\0' for text in texts)
    shown = subprocess.run([program], input=packets, stdout=subprocess.PIPE, check=True).stdout
    assert shown == b''.join(cobs_encode(b'\x3c' + text) + b'\0' for text in texts[:3]) + (
        cobs_encode(b'\x02command 50 has 17 bytes, its struct 16\0') + b'\0')


def test_a_double_in_a_layout_does_not_compile_for_the_avr_and_says_why(sketch):
    (sketch / 'wide.yaml').write_text('arduino: {messages: {wide: {type: 40, ros_type: '
                                      'std_msgs/Float64, layout: "<d", fields: [data]}}}')
    (sketch / 'wide.h').write_bytes(
        subprocess.check_output(HEADER + [str(sketch / 'wide.yaml')]))
    (sketch / 'wide.cpp').write_text('#include "wide.h"\n')
    check(ON_THE_ESP, str(sketch / 'wide.cpp'))
    with pytest.raises(AssertionError, match='on an AVR use f in the layout'):
        check(ON_THE_AVR, str(sketch / 'wide.cpp'))
