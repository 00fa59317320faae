// See sht3x.h.

#include "sht3x.h"

#include <avr_i2c.h>

using serial_communication::i2c_transfer;

namespace {

const uint8_t kAddress = 0x44;
const uint8_t kSingleShot[2] = {0x24, 0x00};  // high repeatability, no clock stretching
const uint8_t kSoftReset[2] = {0x30, 0xA2};
const uint32_t kMeasuringMs = 20;
const uint32_t kPeriodMs = 250;
const uint32_t kValidMs = 2000;

// A word and its CRC (polynomial 0x31, from 0xFF): over all three bytes the CRC is 0.
bool take_word(const uint8_t* bytes, uint16_t* word) {
  *word = uint16_t(bytes[0]) << 8 | bytes[1];
  uint8_t crc = 0xFF;
  for (uint8_t i = 0; i < 3; ++i) {
    crc ^= bytes[i];
    for (uint8_t bit = 0; bit < 8; ++bit) crc = crc & 0x80 ? crc << 1 ^ 0x31 : crc << 1;
  }
  return crc == 0;
}

}  // namespace

void Sht3x::poll(uint32_t now_ms) {
  const uint32_t since = now_ms - started_ms_;
  if (now_ms - measured_ms_ >= kValidMs) measured_ = false;  // for good: after 49.7 days the difference is 0 again
  if (measuring_ && since >= kMeasuringMs) {
    measuring_ = false;
    if (fetch()) {
      measured_ = true;
      measured_ms_ = now_ms;
    } else {
      i2c_transfer(kAddress, kSoftReset, sizeof kSoftReset, 0, 0);
    }
  } else if (!measuring_ && since >= kPeriodMs) {
    started_ms_ = now_ms;
    measuring_ = start();
  }
}


bool Sht3x::start() { return i2c_transfer(kAddress, kSingleShot, sizeof kSingleShot, 0, 0); }

bool Sht3x::fetch() {
  uint16_t temperature, humidity;
  uint8_t bytes[6];
  if (!i2c_transfer(kAddress, 0, 0, bytes, sizeof bytes)) return false;
  if (!take_word(bytes, &temperature) || !take_word(bytes + 3, &humidity)) return false;
  temperature_ = int16_t((int32_t(temperature) * 17500 + 32767) / 65535 - 4500);
  humidity_ = uint16_t((uint32_t(humidity) * 10000 + 32767) / 65535);
  return true;
}
