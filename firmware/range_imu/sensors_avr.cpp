// The bus and the VL53L0X on an AVR. Enough for the emulated sensor. A real VL53L0X needs the long
// initialisation of Pololu's library and does not range without it.

#if defined(ARDUINO_ARCH_AVR)

#include <avr_i2c.h>

#include "sensors.h"
#include "tca9548a.h"

namespace {

const uint8_t kVl53l0x = 0x29;
const uint8_t kRangeStart = 0x00;
const uint8_t kInterruptClear = 0x0B;
const uint8_t kInterruptStatus = 0x13;
const uint8_t kRangeStatus = 0x14;
const uint8_t kRangeResult = 0x1E;
const uint8_t kModelId = 0xC0;

}  // namespace

void sensors_begin() { i2c_begin(); }

bool bus_write(uint8_t device, const uint8_t* bytes, uint8_t size) {
  return i2c_transfer(device, bytes, size, 0, 0);
}

bool bus_read(uint8_t device, uint8_t reg, uint8_t* out, uint8_t size) {
  return i2c_read_registers(device, reg, out, size);
}

bool range_begin(uint8_t sensor) {
  uint8_t model = 0;
  return range_reset(sensor) && i2c_read_registers(kVl53l0x, kModelId, &model, 1) && model == 0xEE &&
         i2c_write_register(kVl53l0x, kRangeStart, 0x02);
}

bool range_read(uint8_t sensor, uint16_t* millimetres) {
  uint8_t status = 0, result = 0;
  uint8_t raw[2];
  if (!tca_select(kRangeChannels[sensor])) return false;
  if (!i2c_read_registers(kVl53l0x, kInterruptStatus, &status, 1) || (status & 0x07) == 0) return false;
  if (!i2c_read_registers(kVl53l0x, kRangeStatus, &result, 1) || range_error(result)) return false;
  if (!i2c_read_registers(kVl53l0x, kRangeResult, raw, 2)) return false;
  *millimetres = uint16_t(raw[0]) << 8 | raw[1];
  return i2c_write_register(kVl53l0x, kInterruptClear, 0x01);
}

#endif
