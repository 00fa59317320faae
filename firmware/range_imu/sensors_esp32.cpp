// The bus and the VL53L0X on an ESP32, the latter through Pololu's library. The tests compile this file
// against stubs with the libraries' signatures; it has not run on an ESP32.

#if defined(ARDUINO_ARCH_ESP32)

#include <VL53L0X.h>
#include <Wire.h>

#include "sensors.h"
#include "tca9548a.h"

static VL53L0X ranges[2];

void sensors_begin() {
  Wire.begin(21, 22);
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
  if (!tca_select(kRangeChannels[sensor]) || !ranges[sensor].init()) return false;
  ranges[sensor].startContinuous();
  return ranges[sensor].last_status == 0;
}

bool range_read(uint8_t sensor, uint16_t* millimetres) {
  VL53L0X& range = ranges[sensor];
  if (!tca_select(kRangeChannels[sensor])) return false;
  // The library's read waits for a measurement, so it is called only when one is ready.
  const uint8_t status = range.readReg(VL53L0X::RESULT_INTERRUPT_STATUS);
  if (range.last_status != 0 || (status & 0x07) == 0) return false;
  *millimetres = range.readRangeContinuousMillimeters();
  return range.last_status == 0 && !range.timeoutOccurred();
}

#endif
