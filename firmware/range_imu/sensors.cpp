// The multiplexer and the BNO055, by their registers; see sensors.h.

#include "sensors.h"

#include <Arduino.h>

#include "tca9548a.h"

namespace {

const uint8_t kTca = 0x70;

const uint8_t kBno055 = 0x28;
const uint8_t kChipId = 0x00;
const uint8_t kEulerHeading = 0x1A;
const uint8_t kSystemStatus = 0x39;
const uint8_t kOperationMode = 0x3D;
const uint8_t kSystemTrigger = 0x3F;
const uint8_t kFusionMode = 0x0C;
const uint8_t kFusionRuns = 5;
const uint8_t kReset = 0x20;

const uint8_t kVl53l0x = 0x29;
const uint8_t kSoftReset = 0xBF;  // 0: the VL53L0X is in reset

// Sixteenths of a degree, low byte first, to hundredths.
int32_t hundredths(const uint8_t* raw) {
  const int16_t sixteenths = int16_t(uint16_t(raw[1]) << 8 | raw[0]);
  return (int32_t(sixteenths) * 25 + (sixteenths < 0 ? -2 : 2)) / 4;
}

}  // namespace

bool tca_select(uint8_t channel) {
  const uint8_t channels = uint8_t(1 << channel);
  return bus_write(kTca, &channels, 1);
}

bool attitude_begin() {
  uint8_t id = 0;
  uint8_t mode = 0;
  if (!bus_read(kBno055, kChipId, &id, 1) || id != 0xA0) return false;
  if (!bus_read(kBno055, kOperationMode, &mode, 1)) return false;
  // Without power it has lost its mode. One that has it and computes nothing has a fault (a system error), which
  // only a reset ends; that takes 0.65 s, so the next start sets the mode.
  const bool has_fault = mode == kFusionMode;
  const uint8_t order[2] = {has_fault ? kSystemTrigger : kOperationMode, has_fault ? kReset : kFusionMode};
  return bus_write(kBno055, order, sizeof order) && !has_fault;
}

bool range_reset(uint8_t sensor) {
  const uint8_t hold[2] = {kSoftReset, 0};
  const uint8_t release[2] = {kSoftReset, 1};
  if (!tca_select(kRangeChannels[sensor]) || !bus_write(kVl53l0x, hold, sizeof hold)) return false;
  delay(1);
  if (!bus_write(kVl53l0x, release, sizeof release)) return false;
  delay(2);  // it boots in 1.2 ms
  return true;
}

bool range_error(uint8_t result_status) {
  const uint8_t code = result_status >> 3 & 0x0F;
  return code >= 1 && code <= 3;  // its laser or its voltage failed its test
}

bool attitude_read(Attitude* attitude) {
  // The data sheet calls the second angle roll and the third pitch; the second is the one limited
  // to ±90 degrees, which is usually called pitch.
  uint8_t status = 0;
  uint8_t raw[6];
  if (!bus_read(kBno055, kSystemStatus, &status, 1) || status != kFusionRuns) return false;
  if (!bus_read(kBno055, kEulerHeading, raw, sizeof raw)) return false;
  attitude->yaw = hundredths(raw);
  attitude->pitch = int16_t(hundredths(raw + 2));
  attitude->roll = int16_t(hundredths(raw + 4));
  return true;
}
