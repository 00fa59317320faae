// range_imu as on an ESP32, on the PC: the sketch, least models of its sensors, and a clock that only waiting and
// transfers move.
//
//   esp32_sensor_board SECONDS [NAME=VALUE …]
//
// prints a line for each frame: milliseconds and the bytes. Values are range1, range2 (mm; 0: it has no power),
// heading, and sda_stuck (clocks until a device lets SDA go).

#include <Arduino.h>
#include <VL53L0X.h>
#include <Wire.h>
#include <stdio.h>
#include <stdlib.h>

#include <map>
#include <string>
#include <vector>

namespace {

const uint8_t kSda = 21, kScl = 22;
const uint64_t kRangingUs = 33000;

uint64_t now_us = 0;
std::map<std::string, double> values = {{"range1", 800}, {"range2", 600}};
bool loop_watched = false, wire_has_pins = false;
uint8_t channels = 0;  // of the TCA9548A
uint8_t bno055_mode = 0;

struct Range {
  const char* name;
  uint64_t ready_us;
} ranges[2] = {{"range1", UINT64_MAX}, {"range2", UINT64_MAX}};

bool bus_works() { return wire_has_pins && values["sda_stuck"] == 0; }

// The one behind the channel that is open; null: it does not answer.
Range* selected() {
  Range* range = channels == 1 << 3 ? ranges : channels == 1 << 6 ? ranges + 1 : nullptr;
  return range && bus_works() && values[range->name] != 0 ? range : nullptr;
}

bool answers(uint8_t address) {
  return bus_works() && (address == 0x70 || address == 0x28 || (address == 0x29 && selected()));
}

void write_to(uint8_t address, const std::vector<uint8_t>& bytes) {
  if (address == 0x70) channels = bytes.at(0);
  if (address == 0x29 && bytes.size() == 2 && bytes[0] == 0xBF && bytes[1] == 0) selected()->ready_us = UINT64_MAX;
  if (address == 0x28 && bytes.size() == 2 && bytes[0] == 0x3D) bno055_mode = bytes[1];
}

uint8_t read_bno055(uint8_t reg) {
  const uint16_t heading = uint16_t(values["heading"] * 16);
  switch (reg) {
    case 0x00: return 0xA0;
    case 0x3D: return bno055_mode;
    case 0x39: return bno055_mode == 0x0C ? 5 : 0;
    case 0x1A: return uint8_t(heading);
    case 0x1B: return uint8_t(heading >> 8);
    default: return 0;
  }
}

}  // namespace

// The core

unsigned long millis() {
  return static_cast<uint32_t>(++now_us / 1000);
}
unsigned long micros() { return static_cast<uint32_t>(now_us); }
void delay(uint32_t ms) { now_us += ms * 1000ull; }
void delayMicroseconds(uint32_t us) { now_us += us; }
void enableLoopWDT() { loop_watched = true; }
void feedLoopWDT() {}
void pinMode(uint8_t, uint8_t) {}
int digitalRead(uint8_t pin) { return pin == kSda && values["sda_stuck"] > 0 ? LOW : HIGH; }
void digitalWrite(uint8_t pin, uint8_t level) {
  double& stuck = values["sda_stuck"];
  if (pin == kScl && level == HIGH && stuck > 0 && !wire_has_pins) --stuck;
}

HardwareSerial Serial;
void HardwareSerial::begin(unsigned long, uint32_t, int8_t, int8_t, bool, unsigned long, uint8_t) {}
int HardwareSerial::available() { return 0; }
int HardwareSerial::read() { return -1; }
size_t HardwareSerial::write(uint8_t byte) { return write(&byte, 1); }
size_t HardwareSerial::write(const uint8_t* bytes, size_t size) {
  printf("%llu ", static_cast<unsigned long long>(now_us / 1000));
  for (size_t i = 0; i < size; ++i) printf("%02x", bytes[i]);
  puts("");
  return size;
}

TwoWire Wire;
static uint8_t wire_address, wire_pointer;
static std::vector<uint8_t> wire_out;
static int wire_left = 0;

bool TwoWire::begin(int, int, uint32_t) { return wire_has_pins = true; }
bool TwoWire::setClock(uint32_t) { return true; }
void TwoWire::setTimeOut(uint16_t) {}
void TwoWire::beginTransmission(uint8_t address) {
  wire_address = address;
  wire_out.clear();
}
size_t TwoWire::write(uint8_t byte) { return write(&byte, 1); }
size_t TwoWire::write(const uint8_t* bytes, size_t size) {
  wire_out.insert(wire_out.end(), bytes, bytes + size);
  return size;
}
uint8_t TwoWire::endTransmission(bool) {
  now_us += 25 * (1 + wire_out.size());
  if (!answers(wire_address)) return 2;
  wire_pointer = wire_out.at(0);
  write_to(wire_address, wire_out);
  return 0;
}
uint8_t TwoWire::requestFrom(uint8_t address, uint8_t size) {
  now_us += 25 * (1 + size);
  wire_left = answers(address) ? size : 0;
  return uint8_t(wire_left);
}
int TwoWire::read() { return wire_left-- > 0 ? read_bno055(wire_pointer++) : -1; }

// Pololu's library

VL53L0X::VL53L0X() : last_status(0) {}
bool VL53L0X::init(bool) { return selected() != nullptr; }
void VL53L0X::startContinuous(uint32_t) {
  last_status = selected() ? 0 : 2;
  if (selected()) selected()->ready_us = now_us + kRangingUs;
}
uint8_t VL53L0X::readReg(uint8_t reg) {
  last_status = selected() ? 0 : 2;
  if (reg == RESULT_RANGE_STATUS) return 11 << 3;  // complete
  return selected() && now_us >= selected()->ready_us ? 7 : 0;
}
uint16_t VL53L0X::readRangeContinuousMillimeters() {
  selected()->ready_us = now_us + kRangingUs;
  return uint16_t(values[selected()->name]);
}
void VL53L0X::setTimeout(uint16_t) {}
bool VL53L0X::timeoutOccurred() { return false; }

void setup();
void loop();

int main(int count, char** arguments) {
  if (count < 2) return 2;
  for (int i = 2; i < count; ++i) {
    const std::string word = arguments[i];
    const size_t sign = word.find('=');
    values[word.substr(0, sign)] = atof(word.c_str() + sign + 1);
  }
  setup();
  if (!loop_watched) return 3;
  while (now_us < atof(arguments[1]) * 1e6) loop();
  return 0;
}
