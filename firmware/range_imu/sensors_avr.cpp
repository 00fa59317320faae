// The sensors on an AVR, by their registers. Enough for the emulated sensors and for a BNO055; a real
// VL53L0X wants the long initialisation that Pololu's library does, and does not range without it.

#if defined(ARDUINO_ARCH_AVR)

#include <Wire.h>

#include "sensors.h"
#include "tca9548a.h"

namespace {

const uint8_t kVl53l0x = 0x29;
const uint8_t kRangeStart = 0x00;
const uint8_t kInterruptClear = 0x0B;
const uint8_t kInterruptStatus = 0x13;
const uint8_t kRangeResult = 0x1E;
const uint8_t kModelId = 0xC0;

const uint8_t kBno055 = 0x28;
const uint8_t kChipId = 0x00;
const uint8_t kEulerHeading = 0x1A;
const uint8_t kOperationMode = 0x3D;
const uint8_t kFusionMode = 0x0C;

bool write_register(uint8_t device, uint8_t reg, uint8_t value) {
  Wire.beginTransmission(device);
  Wire.write(reg);
  Wire.write(value);
  return Wire.endTransmission() == 0;
}

bool read_registers(uint8_t device, uint8_t reg, uint8_t* out, uint8_t size) {
  Wire.beginTransmission(device);
  Wire.write(reg);
  if (Wire.endTransmission(false) != 0) return false;
  if (Wire.requestFrom(device, size) != size) return false;
  for (uint8_t i = 0; i < size; ++i) out[i] = Wire.read();
  return true;
}

// Sixteenths of a degree, low byte first, to hundredths.
int32_t hundredths(const uint8_t* raw) {
  const int16_t sixteenths = int16_t(uint16_t(raw[1]) << 8 | raw[0]);
  return (int32_t(sixteenths) * 25 + (sixteenths < 0 ? -2 : 2)) / 4;
}

}  // namespace

void sensors_begin() {
  Wire.begin();
  Wire.setClock(400000);
  Wire.setWireTimeout(3000, true);
}

bool range_begin(uint8_t sensor) {
  uint8_t model = 0;
  return tca_select(kRangeChannels[sensor]) && read_registers(kVl53l0x, kModelId, &model, 1) && model == 0xEE &&
         write_register(kVl53l0x, kRangeStart, 0x02);
}

bool range_read(uint8_t sensor, uint16_t* millimetres) {
  uint8_t status = 0;
  uint8_t raw[2];
  if (!tca_select(kRangeChannels[sensor])) return false;
  if (!read_registers(kVl53l0x, kInterruptStatus, &status, 1) || (status & 0x07) == 0) return false;
  if (!read_registers(kVl53l0x, kRangeResult, raw, 2)) return false;
  *millimetres = uint16_t(raw[0]) << 8 | raw[1];
  return write_register(kVl53l0x, kInterruptClear, 0x01);
}

bool attitude_begin() {
  uint8_t id = 0;
  return read_registers(kBno055, kChipId, &id, 1) && id == 0xA0 && write_register(kBno055, kOperationMode, kFusionMode);
}

bool attitude_read(Attitude* attitude) {
  // The data sheet calls the second angle roll and the third pitch; the second is the one that ends
  // at ±90 degrees, which is pitch for everybody else.
  uint8_t raw[6];
  if (!read_registers(kBno055, kEulerHeading, raw, sizeof raw)) return false;
  attitude->yaw = hundredths(raw);
  attitude->pitch = int16_t(hundredths(raw + 2));
  attitude->roll = int16_t(hundredths(raw + 4));
  return true;
}

#endif
