// range_imu as on an ESP32, on the PC: the sketch, its sensors' registers as models, and a clock that only waiting
// and transfers move. With the stub of VL53L0X.h, or with Pololu's library in the include path before it.
//
//   esp32_sensor_board SECONDS [MS:NAME=VALUE …]
//
// prints a line for each frame: milliseconds and the bytes. At the given time a value changes: range1 (mm),
// range1_power, range1_error, range2 …, heading, bno055_power, bno055_error, sda_stuck (clocks).

#include <Arduino.h>
#include <VL53L0X.h>
#include <Wire.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <map>
#include <string>
#include <vector>

namespace model {

const uint8_t kSda = 21, kScl = 22;

uint64_t now_us = 0;
std::map<std::string, double> values = {{"range1", 800}, {"range1_power", 1}, {"range2", 600}, {"range2_power", 1},
                                        {"bno055_power", 1}};
struct Event {
  uint64_t at_us;
  std::string name;
  double value;
};
std::vector<Event> events;  // in order
bool loop_watched = false, wire_has_pins = false;

struct Device {
  uint8_t registers[16][256] = {};  // by page
  uint8_t pointer = 0;

  virtual ~Device() {}
  virtual bool answers() { return true; }
  virtual void before_read() {}
  virtual void written(uint8_t, uint8_t) {}
  virtual uint8_t page() { return 0; }
  void write(const std::vector<uint8_t>& bytes) {
    if (bytes.empty()) return;
    pointer = bytes[0];
    for (size_t i = 1; i < bytes.size(); ++i, ++pointer) {
      registers[page()][pointer] = bytes[i];
      written(pointer, bytes[i]);
    }
  }
  uint8_t read() {
    before_read();
    return registers[page()][pointer++];
  }
};

struct Vl53l0x : Device {
  explicit Vl53l0x(const char* name) : name_(name) { power_on(); }
  void power_on() {
    memset(registers, 0, sizeof registers);
    registers[0][0xC0] = 0xEE;
    continuous_ = false;
    ready_us_ = UINT64_MAX;
    page_ = 0;
  }
  bool answers() override {
    const bool powered = values[name_ + "_power"] != 0;
    if (!powered) power_on();
    return powered;
  }
  uint8_t page() override { return page_; }
  void before_read() override {
    if (page_ != 0) {
      registers[page_][0x83] = 1;  // the SPADs are read
      return;
    }
    const double error = values[name_ + "_error"];
    registers[0][0x13] = now_us >= ready_us_ ? 7 : 0;
    registers[0][0x14] = uint8_t(error != 0 ? error : 11) << 3;
    const uint16_t range = uint16_t(values[name_]);
    registers[0][0x1E] = uint8_t(range >> 8);
    registers[0][0x1F] = uint8_t(range);
  }
  void written(uint8_t reg, uint8_t value) override {
    if (reg == 0xFF) {
      page_ = value & 15;
    } else if (page_ == 0 && reg == 0xBF && value == 0) {
      power_on();
      values[name_ + "_error"] = 0;
    } else if (page_ == 0 && reg == 0x00) {
      continuous_ = value == 2;
      ready_us_ = value != 0 ? now_us + 33000 : UINT64_MAX;
    } else if (page_ == 0 && reg == 0x0B) {
      ready_us_ = continuous_ ? now_us + 33000 : UINT64_MAX;
    }
  }

 private:
  std::string name_;
  bool continuous_;
  uint64_t ready_us_;
  uint8_t page_;
};

struct Bno055 : Device {
  Bno055() { power_on(0); }
  void power_on(uint64_t boots_us) {
    memset(registers, 0, sizeof registers);
    registers[0][0x00] = 0xA0;
    boots_until_us_ = now_us + boots_us;
    fusion_us_ = UINT64_MAX;
  }
  bool answers() override {
    const bool powered = values["bno055_power"] != 0;
    if (!powered) power_on(400000);
    return powered && now_us >= boots_until_us_;
  }
  void before_read() override {
    const bool fuses = values["bno055_error"] == 0 && now_us >= fusion_us_;
    registers[0][0x39] = values["bno055_error"] != 0 ? 1 : fuses ? 5 : 0;
    const uint16_t heading = fuses ? uint16_t(values["heading"] * 16) : 0;
    registers[0][0x1A] = uint8_t(heading);
    registers[0][0x1B] = uint8_t(heading >> 8);
  }
  void written(uint8_t reg, uint8_t value) override {
    if (reg == 0x3D) fusion_us_ = value == 0x0C ? now_us + 20000 : UINT64_MAX;
    if (reg == 0x3F && (value & 0x20)) {
      values["bno055_error"] = 0;
      power_on(650000);
    }
  }

 private:
  uint64_t boots_until_us_, fusion_us_;
};

struct Tca9548a : Device {
  uint8_t mask = 0;
} tca;

Vl53l0x range1("range1"), range2("range2");
Bno055 bno055;

Device* device(uint8_t address) {
  if (!wire_has_pins || values["sda_stuck"] > 0) return nullptr;  // the peripheral frees no line
  Device* found = address == 0x70 ? &tca : address == 0x28 ? &bno055 : address != 0x29 ? nullptr
      : tca.mask == 1 << 3 ? &range1 : tca.mask == 1 << 6 ? static_cast<Device*>(&range2) : nullptr;
  return found && found->answers() ? found : nullptr;
}

void pass(uint64_t us) {
  now_us += us;
  while (!events.empty() && events.front().at_us <= now_us) {
    values[events.front().name] = events.front().value;
    events.erase(events.begin());
  }
}

}  // namespace model

unsigned long millis() {
  model::pass(1);
  return static_cast<uint32_t>(model::now_us / 1000);
}
unsigned long micros() { return static_cast<uint32_t>(model::now_us); }
void delay(uint32_t ms) { model::pass(ms * 1000ull); }
void delayMicroseconds(uint32_t us) { model::pass(us); }
void enableLoopWDT() { model::loop_watched = true; }
void feedLoopWDT() {}
void pinMode(uint8_t, uint8_t) {}
int digitalRead(uint8_t pin) { return pin == model::kSda && model::values["sda_stuck"] > 0 ? LOW : HIGH; }
void digitalWrite(uint8_t pin, uint8_t level) {
  double& stuck = model::values["sda_stuck"];
  if (pin == model::kScl && level == HIGH && stuck > 0 && !model::wire_has_pins) --stuck;
}

HardwareSerial Serial;
void HardwareSerial::begin(unsigned long, uint32_t, int8_t, int8_t, bool, unsigned long, uint8_t) {}
int HardwareSerial::available() { return 0; }
int HardwareSerial::read() { return -1; }
size_t HardwareSerial::write(uint8_t byte) { return write(&byte, 1); }
size_t HardwareSerial::write(const uint8_t* bytes, size_t size) {
  printf("%llu ", static_cast<unsigned long long>(model::now_us / 1000));
  for (size_t i = 0; i < size; ++i) printf("%02x", bytes[i]);
  puts("");
  return size;
}

TwoWire Wire;
static uint8_t wire_address;
static std::vector<uint8_t> wire_out, wire_in;

bool TwoWire::begin(int, int, uint32_t) { return model::wire_has_pins = true; }
bool TwoWire::setClock(uint32_t) { return true; }
void TwoWire::setTimeOut(uint16_t) {}
void TwoWire::beginTransmission(uint8_t address) {
  wire_address = address;
  wire_out.clear();
}
void TwoWire::beginTransmission(uint16_t address) { beginTransmission(uint8_t(address)); }
void TwoWire::beginTransmission(int address) { beginTransmission(uint8_t(address)); }
size_t TwoWire::write(uint8_t byte) { return write(&byte, 1); }
size_t TwoWire::write(const uint8_t* bytes, size_t size) {
  wire_out.insert(wire_out.end(), bytes, bytes + size);
  return size;
}
uint8_t TwoWire::endTransmission() { return endTransmission(true); }
uint8_t TwoWire::endTransmission(bool) {
  model::pass(25 * (1 + wire_out.size()));
  model::Device* const device = model::device(wire_address);
  if (!device) return 2;
  if (device == &model::tca) {
    if (!wire_out.empty()) model::tca.mask = wire_out[0];
  } else {
    device->write(wire_out);
  }
  return 0;
}
uint8_t TwoWire::requestFrom(uint8_t address, uint8_t size) {
  wire_in.clear();
  model::pass(25 * (1 + size));
  model::Device* const device = model::device(address);
  if (!device) return 0;
  for (uint8_t i = 0; i < size; ++i) wire_in.push_back(device->read());
  return size;
}
uint8_t TwoWire::requestFrom(int address, int size) { return requestFrom(uint8_t(address), uint8_t(size)); }
int TwoWire::available() { return int(wire_in.size()); }
int TwoWire::read() {
  if (wire_in.empty()) return -1;
  const uint8_t byte = wire_in.front();
  wire_in.erase(wire_in.begin());
  return byte;
}

#if defined(STUB_VL53L0X_H)
// The least of Pololu's library.
VL53L0X::VL53L0X() : last_status(0) {}
static void write_register(VL53L0X& range, uint8_t reg, uint8_t value) {
  const uint8_t bytes[2] = {reg, value};
  Wire.beginTransmission(uint8_t(0x29));
  Wire.write(bytes, sizeof bytes);
  range.last_status = Wire.endTransmission();
}
uint8_t VL53L0X::readReg(uint8_t reg) {
  Wire.beginTransmission(uint8_t(0x29));
  Wire.write(reg);
  last_status = Wire.endTransmission();
  Wire.requestFrom(uint8_t(0x29), uint8_t(1));
  return uint8_t(Wire.read());
}
bool VL53L0X::init(bool) { return readReg(0xC0) == 0xEE; }
void VL53L0X::startContinuous(uint32_t) { write_register(*this, 0x00, 0x02); }
uint16_t VL53L0X::readRangeContinuousMillimeters() {
  const uint16_t range = uint16_t(readReg(0x1E) << 8 | readReg(0x1F));
  write_register(*this, 0x0B, 0x01);
  return range;
}
void VL53L0X::setTimeout(uint16_t) {}
bool VL53L0X::timeoutOccurred() { return false; }
#endif

void setup();
void loop();

int main(int count, char** arguments) {
  if (count < 2) return 2;
  for (int i = 2; i < count; ++i) {
    unsigned ms;
    char name[32];
    double value;
    if (sscanf(arguments[i], "%u:%31[a-z0-9_]=%lf", &ms, name, &value) != 3) return 2;
    model::events.push_back({ms * 1000ull, name, value});
  }
  model::pass(0);
  setup();
  if (!model::loop_watched) return 3;
  while (model::now_us < atof(arguments[1]) * 1e6) loop();
  return 0;
}
