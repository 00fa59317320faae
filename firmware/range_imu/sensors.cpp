// The multiplexer and the BNO055, by their registers; see sensors.h.

#include "sensors.h"

#include "tca9548a.h"

namespace {

const uint8_t kTca = 0x70;

const uint8_t kBno055 = 0x28;
const uint8_t kChipId = 0x00;
const uint8_t kEulerHeading = 0x1A;
const uint8_t kSystemStatus = 0x39;
const uint8_t kOperationMode = 0x3D;
const uint8_t kFusionMode = 0x0C;
const uint8_t kFusionRuns = 5;

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
  const uint8_t mode[2] = {kOperationMode, kFusionMode};
  return bus_read(kBno055, kChipId, &id, 1) && id == 0xA0 && bus_write(kBno055, mode, sizeof mode);
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
