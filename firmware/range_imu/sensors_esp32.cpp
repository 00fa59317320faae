// The bus and the VL53L0X on an ESP32, the latter through Pololu's library. The tests run this file on the PC with
// models of the sensors' registers; it has not run on an ESP32.

#if defined(ARDUINO_ARCH_ESP32)

#include <VL53L0X.h>
#include <Wire.h>

#include "sensors.h"
#include "tca9548a.h"

static const uint8_t kSda = 21, kScl = 22;

static VL53L0X ranges[2];

// After a reset in the middle of a read a device may hold SDA until it has sent its byte: nine clocks and a stop
// condition free it. Wire cannot send them before it has the pins.
static void free_bus() {
  pinMode(kSda, INPUT_PULLUP);
  pinMode(kScl, OUTPUT_OPEN_DRAIN);
  for (uint8_t clocks = 9; clocks > 0 && digitalRead(kSda) == LOW; --clocks) {
    digitalWrite(kScl, LOW);
    delayMicroseconds(5);
    digitalWrite(kScl, HIGH);
    delayMicroseconds(5);
  }
  digitalWrite(kScl, LOW);
  pinMode(kSda, OUTPUT_OPEN_DRAIN);
  digitalWrite(kSda, LOW);
  delayMicroseconds(5);
  digitalWrite(kScl, HIGH);
  delayMicroseconds(5);
  digitalWrite(kSda, HIGH);
}

void sensors_begin() {
  free_bus();
  Wire.begin(kSda, kScl);
  Wire.setClock(400000);
  Wire.setTimeOut(3);  // ms
  for (VL53L0X& range : ranges) range.setTimeout(50);
}

bool bus_write(uint8_t device, const uint8_t* bytes, uint8_t size) {
  Wire.beginTransmission(device);
  Wire.write(bytes, size);
  return Wire.endTransmission() == 0;
}

bool bus_read(uint8_t device, uint8_t reg, uint8_t* out, uint8_t size) {
  Wire.beginTransmission(device);
  Wire.write(reg);
  if (Wire.endTransmission(false) != 0) return false;
  if (Wire.requestFrom(device, size) != size) return false;
  for (uint8_t i = 0; i < size; ++i) out[i] = uint8_t(Wire.read());
  return true;
}

bool range_begin(uint8_t sensor) {
  if (!range_reset(sensor) || !ranges[sensor].init()) return false;
  ranges[sensor].startContinuous();
  return ranges[sensor].last_status == 0;
}

bool range_read(uint8_t sensor, uint16_t* millimetres) {
  VL53L0X& range = ranges[sensor];
  if (!tca_select(kRangeChannels[sensor])) return false;
  // The library's read waits for a measurement, so it is called only when one is ready.
  const uint8_t status = range.readReg(VL53L0X::RESULT_INTERRUPT_STATUS);
  if (range.last_status != 0 || (status & 0x07) == 0) return false;
  if (range_error(range.readReg(VL53L0X::RESULT_RANGE_STATUS)) || range.last_status != 0) return false;
  *millimetres = range.readRangeContinuousMillimeters();
  return range.last_status == 0 && !range.timeoutOccurred();
}

#endif
