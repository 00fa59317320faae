"""The headers and the sketches with the compilers of other chips; every warning is an error."""

import glob
import os
import subprocess

import pytest

from emulated_board import FIRMWARE

STUBS = os.path.join(os.path.dirname(os.path.abspath(__file__)), 'stubs')
PROTOCOL = os.path.join(FIRMWARE, 'protocol')
CORE = '/usr/share/arduino/hardware/arduino/avr'

ON_THE_PC = ['g++', '-Wcast-align', '-Wshadow']
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


WRONG = {
    'pointer': ('const Force* f = 0; packets.send(40, f);', 'a pointer'),
    'String': ('struct Text { Text(const Text&); char* at; }; Text* t = 0; packets.send(40, *t);',
               'no String'),
    'unpacked struct': ('struct Wide { uint8_t a; uint32_t b; }; Wide w = {1, 2};'
                        ' frames.send(40, w);', 'has to be PACKED'),
    'too much for a packet': ('struct PACKED Big { uint8_t a[64]; }; Big b = {}; '
                              'packets.send(40, b);', 'holds no more'),
    'too much for a decoder': ('struct PACKED Big { uint8_t a[64]; }; decoder.accept<Big>(40);',
                               'holds no more'),
    'too much for a reply': ('struct PACKED Big { uint8_t a[17]; }; BusResult::ok(Big());',
                             'holds no more'),
}
SKETCH = """
#include <arduino_packets.h>
#include <robot_ctrl_bus.h>
#include <stx_etx.h>
using namespace serial_communication;
struct PACKED Force { int16_t centinewtons; };
struct Nowhere { void operator()(const uint8_t*, size_t) const {} };
bool all() {
  static PacketSender<Nowhere> packets{Nowhere()};
  static StxEtxSender<Nowhere> frames{Nowhere()};
  static PacketDecoder<40> decoder;
  const Force force = {1};
  %s
  return packets.send(32, force) && frames.send(32, force) && decoder.accept<Force>(48);
}
"""


@pytest.mark.parametrize('wrong', sorted(WRONG))
def test_what_cannot_be_sent_does_not_compile(wrong, tmp_path):
    """On the ESP: an AVR aligns nothing, so that there every struct is packed."""
    statement, reason = WRONG[wrong]
    source = tmp_path / 'sketch.cpp'
    source.write_text(SKETCH % '')
    check(ON_THE_ESP, str(source))
    source.write_text(SKETCH % statement)
    with pytest.raises(AssertionError, match=reason):
        check(ON_THE_ESP, str(source))


def test_what_does_not_fit_at_run_time_is_told(tmp_path):
    source = tmp_path / 'sketch.cpp'
    program = str(tmp_path / 'sketch')
    source.write_text(SKETCH % '' + """
int main() {
  PacketSender<Nowhere> packets{Nowhere()};
  StxEtxSender<Nowhere> frames{Nowhere()};
  PacketDecoder<40> decoder;
  uint8_t bytes[64] = {0};
  for (uint8_t type = 40; type < 44; ++type) if (!decoder.accept<Force>(type)) return 1;
  if (decoder.accept<Force>(44)) return 2;
  if (packets.send(MessageType::Imu, bytes, 64)) return 3;
  if (!packets.send(MessageType::Imu, bytes, 63)) return 3;
  if (!packets.send(MessageType::Info, bytes, 64)) return 4;
  if (frames.send(40, bytes, 33) || !frames.send(40, bytes, 32)) return 5;
  BusResult result = BusResult::ok();
  for (int i = 0; i < 8; ++i) if (!result.append_uint16(7)) return 6;
  return result.append_uint16(7) || result.size != 16 ? 7 : 0;
}
""")
    subprocess.run(['g++', '-std=c++11', '-fsanitize=address,undefined', '-I', PROTOCOL,
                    str(source), '-o', program], check=True)
    assert subprocess.run([program]).returncode == 0
