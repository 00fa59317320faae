"""A sketch with the library and a header that `header` made: compiled for the AVR, and run here."""
import os
import subprocess
import sys

import pytest

import emulated_board
from serial_communication.boards.arduino import custom_messages
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.config_file import read_parameters

ROOT = os.path.dirname(emulated_board.FIRMWARE)
EXAMPLES = os.path.join(ROOT, 'config', 'custom_messages.yaml')
STRICT = ['-Os', '-Wall', '-Wextra', '-Werror', '-I',
          os.path.join(emulated_board.FIRMWARE, 'protocol')]
SKETCH = '''
#include <arduino_packets.h>

#include "my_robot.h"

using namespace serial_communication;

void write(const uint8_t* bytes, size_t size);
int read();

int main() {
  PacketSender<void (*)(const uint8_t*, size_t)> sender(write);
  PacketDecoder<> decoder;
  decoder.accept<Gripper>(Gripper::TYPE);
  for (int byte = read(); byte >= 0; byte = read()) {
    Gripper gripper;
    if (!decoder.feed(uint8_t(byte), 0) || !decoder.packet().is(Gripper::TYPE, &gripper)) continue;
    const Force force = {gripper.x};
    sender.send(Force::TYPE, force);
    const LineSensors<2> line = {{uint16_t(gripper.x), gripper.z}};
    sender.send(line.TYPE, line);
    const MagneticField field = {1, -1, gripper.x, 258};
    sender.send(field.TYPE, field);
  }
}
'''
STDIO = '''
#include <cstdio>
#include <cstdint>
void write(const uint8_t* bytes, size_t size) { fwrite(bytes, 1, size, stdout); }
int read() { return getchar(); }
'''


@pytest.fixture(scope='module')
def sketch(tmp_path_factory):
    """A folder with a sketch, and the header that it includes."""
    folder = tmp_path_factory.mktemp('sketch')
    header = subprocess.check_output([sys.executable, os.path.join(ROOT, 'scripts', 'header'),
                                      EXAMPLES, 'arduino'])
    (folder / 'my_robot.h').write_bytes(header)
    (folder / 'sketch.cpp').write_text(SKETCH)
    (folder / 'stdio.cpp').write_text(STDIO)
    return folder


def compiled(command):
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                          encoding='utf-8')
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize('link', ['arduino', 'mcu', 'bus'])
def test_the_header_of_every_example_compiles_for_the_avr(sketch, link):
    header = subprocess.check_output([sys.executable, os.path.join(ROOT, 'scripts', 'header'),
                                      EXAMPLES, link])
    (sketch / f'{link}.h').write_bytes(header)
    source = sketch / f'{link}.cpp'
    source.write_text(f'#include "{link}.h"\nint main() {{}}\n')
    compiled(['avr-g++', '-mmcu=atmega328p', '-std=gnu++11', *STRICT, '-c', str(source),
              '-o', str(sketch / f'{link}.o')])


def test_a_sketch_compiles_for_the_avr(sketch):
    compiled(['avr-g++', '-mmcu=atmega328p', '-std=gnu++11', *STRICT, '-c',
              str(sketch / 'sketch.cpp'), '-o', str(sketch / 'sketch.o')])


def test_a_sketch_exchanges_values_with_the_bridge(sketch):
    program = str(sketch / 'program')
    compiled(['g++', '-std=c++11', *STRICT, '-fsanitize=undefined', '-fno-sanitize-recover=all',
              str(sketch / 'sketch.cpp'), str(sketch / 'stdio.cpp'), '-o', program])
    kinds = {custom.name: custom.kind for custom in custom_messages(
        read_parameters(EXAMPLES)['arduino']['messages'])}
    command = kinds['gripper'](12.3, 0.5)
    sent = subprocess.run([program], input=arduino.encode(command), stdout=subprocess.PIPE,
                          check=True).stdout
    assert [frame.text for frame in arduino.Decoder(messages=kinds.values()).feed(sent)] == [
        'force data=1.23', 'line_sensors data=[123 128]',
        'magnetic_field magnetic_field.x=-1.5e-07 magnetic_field.y=1.845e-05 '
        'magnetic_field.z=3.87e-05']


def test_a_double_in_a_layout_does_not_compile_for_the_avr_and_says_why(sketch):
    (sketch / 'wide.yaml').write_text('arduino: {messages: {wide: {type: 40, ros_type: '
                                      'std_msgs/Float64, layout: "<d", fields: [data]}}}')
    (sketch / 'wide.cpp').write_bytes(subprocess.check_output(
        [sys.executable, os.path.join(ROOT, 'scripts', 'header'), str(sketch / 'wide.yaml')]))
    done = subprocess.run(['avr-g++', '-mmcu=atmega328p', '-std=gnu++11', '-fsyntax-only',
                           '-x', 'c++', str(sketch / 'wide.cpp')],
                          stderr=subprocess.PIPE, encoding='utf-8')
    assert done.returncode and 'on an AVR use f in the layout' in done.stderr
