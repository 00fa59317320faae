// See imu.h.

#include "imu.h"

#include <Arduino.h>
#include <avr/eeprom.h>
#include <avr/wdt.h>
#include <avr_i2c.h>
#include <math.h>
#include <string.h>

#include "board.h"

using serial_communication::i2c_read_registers;
using serial_communication::i2c_write_register;

namespace {

const uint8_t kAddress = 0x68;
const uint8_t kSampleRateDivider = 0x19;
const uint8_t kConfig = 0x1A;
const uint8_t kGyroConfig = 0x1B;
const uint8_t kAccelConfig = 0x1C;
const uint8_t kAccelXoutH = 0x3B;
const uint8_t kPowerManagement1 = 0x6B;
const uint8_t kWhoAmI = 0x75;
// Values of WHO_AM_I: MPU6050, MPU6500, MPU9250, and chips that are sold as an MPU6050. They have the same
// registers, but the temperature is right only on an MPU6050.
const uint8_t kKnownIds[] = {0x68, 0x70, 0x71, 0x72, 0x98};

// ±4 g and ±1000 degrees/s: enough for a model car in a crash.
const float kLsbPerG = 8192.0f;
const float kLsbPerDegree = 65536.0f / 2000.0f;
const float kRadiansPerLsb = float(M_PI / 180) / kLsbPerDegree;
// The packet's unit is 4000/65536 * 25 degrees/s, as the processor inside the MPU6050 sends its rates.
const float kPacketPerLsb = (2000.0f / 65536.0f) / (4000.0f / 65536.0f * 25.0f);

const float kProportionalGain = 1.0f;
// How far the measured acceleration may differ from 1 g and still be used as the direction of gravity.
const float kGravityTolerance = 0.15f;

const uint16_t kCalibrationSamples = CALIBRATION_SECONDS * 100UL;
// This number of failed reads in a row ends a calibration, and means that the sensor is lost; fewer are tolerated. A
// sensor that was just started has no values for some hundredths of a second.
const uint8_t kFailedReads = 20;
static_assert(CALIBRATION_SECONDS <= 600, "the sums of a calibration are 32 bits wide");
// If the smallest and the largest rate differ by more, the car has moved: 10 degrees/s.
const int16_t kStillSpread = int16_t(10 * kLsbPerDegree);

const uint32_t kEepromMagic = 0x31554D49;  // "IMU1"
// Not the first cell: it is the one that a failing supply damages.
uint8_t* const kEepromAddress = reinterpret_cast<uint8_t*>(16);

struct StoredOffsets {
  uint32_t magic;
  float offsets[6];
  uint8_t checksum;
};

uint8_t checksum_of(const StoredOffsets& stored) {
  uint8_t sum = 0x55;
  const uint8_t* bytes = reinterpret_cast<const uint8_t*>(&stored);
  for (uint8_t i = 0; i < offsetof(StoredOffsets, checksum); ++i) sum = (sum << 1 | sum >> 7) ^ bytes[i];
  return sum;
}

bool write_register(uint8_t reg, uint8_t value) { return i2c_write_register(kAddress, reg, value); }

bool read_registers(uint8_t reg, uint8_t* out, uint8_t size) {
  return i2c_read_registers(kAddress, reg, out, size);
}

bool known(uint8_t id) { return memchr(kKnownIds, id, sizeof kKnownIds) != 0; }

int16_t saturate(float value) {
  return int16_t(lroundf(value > 32767 ? 32767 : value < -32768 ? -32768 : value));
}

}  // namespace

bool Imu::begin() {
  load();
  aligned_ = false;
  failed_reads_ = 0;
  uint8_t id = 0;
  return read_registers(kWhoAmI, &id, 1) && known(id) && write_register(kPowerManagement1, 0x01) &&
         write_register(kSampleRateDivider, 9) && write_register(kConfig, 0x03) &&
         write_register(kGyroConfig, 0x10) && write_register(kAccelConfig, 0x08);
}

bool Imu::lost() const { return failed_reads_ >= kFailedReads; }

bool Imu::read(Sample* sample) {
  uint8_t raw[14];
  ++failed_reads_;
  if (!read_registers(kAccelXoutH, raw, sizeof raw)) return false;
  int16_t fields[7];
  for (uint8_t i = 0; i < 7; ++i) fields[i] = int16_t(uint16_t(raw[2 * i]) << 8 | raw[2 * i + 1]);
  memcpy(sample, fields, sizeof *sample);
  const int16_t* a = sample->acceleration;
  if (a[0] == 0 && a[1] == 0 && a[2] == 0) return false;  // gravity is always there: it is asleep
  failed_reads_ = 0;
  return true;
}

bool Imu::update(float seconds, ImuData* out) {
  Sample sample;
  if (!read(&sample)) return false;
  float acceleration[3];
  float rate[3];
  for (uint8_t i = 0; i < 3; ++i) {
    acceleration[i] = sample.acceleration[i] - offsets_.acceleration[i];
    rate[i] = sample.rate[i] - offsets_.rate[i];
    out->acceleration[i] = saturate(acceleration[i]);
    out->angular_velocity[i] = saturate(rate[i] * kPacketPerLsb);
    acceleration[i] /= kLsbPerG;
    rate[i] *= kRadiansPerLsb;
  }
  if (!aligned_) {
    align(acceleration);
  } else {
    rotate(acceleration, rate, seconds);
  }
  for (uint8_t i = 0; i < 4; ++i) out->quaternion[i] = saturate(q_[i] * 16384.0f);
  out->temperature = sample.temperature;
  return true;
}

// Starts with roll and pitch from the direction of gravity, and with heading 0.
void Imu::align(const float a[3]) {
  const float roll = atan2f(a[1], a[2]) / 2;
  const float pitch = atan2f(-a[0], sqrtf(a[1] * a[1] + a[2] * a[2])) / 2;
  q_[0] = cosf(roll) * cosf(pitch);
  q_[1] = sinf(roll) * cosf(pitch);
  q_[2] = cosf(roll) * sinf(pitch);
  q_[3] = -sinf(roll) * sinf(pitch);
  aligned_ = true;
}

// One step of Mahony's filter: the rate, corrected towards the direction of gravity.
void Imu::rotate(const float a[3], const float rate[3], float seconds) {
  float x = rate[0];
  float y = rate[1];
  float z = rate[2];
  const float norm = sqrtf(a[0] * a[0] + a[1] * a[1] + a[2] * a[2]);
  if (fabsf(norm - 1.0f) < kGravityTolerance) {
    // The direction "up" of the present orientation, in the sensor's axes.
    const float up_x = 2 * (q_[1] * q_[3] - q_[0] * q_[2]);
    const float up_y = 2 * (q_[0] * q_[1] + q_[2] * q_[3]);
    const float up_z = 1 - 2 * (q_[1] * q_[1] + q_[2] * q_[2]);
    const float gain = kProportionalGain / norm;
    x += gain * (a[1] * up_z - a[2] * up_y);
    y += gain * (a[2] * up_x - a[0] * up_z);
    z += gain * (a[0] * up_y - a[1] * up_x);
  }
  const float half = seconds / 2;
  const float w = q_[0], i = q_[1], j = q_[2], k = q_[3];
  q_[0] += half * (-i * x - j * y - k * z);
  q_[1] += half * (w * x + j * z - k * y);
  q_[2] += half * (w * y - i * z + k * x);
  q_[3] += half * (w * z + i * y - j * x);
  const float scale = 1 / sqrtf(q_[0] * q_[0] + q_[1] * q_[1] + q_[2] * q_[2] + q_[3] * q_[3]);
  for (uint8_t n = 0; n < 4; ++n) q_[n] *= scale;
}

void Imu::start_calibration() {
  samples_ = 0;
  failed_reads_ = 0;
  for (uint8_t i = 0; i < 3; ++i) {
    sum_acceleration_[i] = sum_rate_[i] = 0;
    rate_min_[i] = INT16_MAX;
    rate_max_[i] = INT16_MIN;
  }
}

Imu::Calibration Imu::calibrate() {
  Sample sample;
  if (!read(&sample)) return lost() ? Failed : Running;
  for (uint8_t i = 0; i < 3; ++i) {
    sum_acceleration_[i] += sample.acceleration[i];
    sum_rate_[i] += sample.rate[i];
    rate_min_[i] = min(rate_min_[i], sample.rate[i]);
    rate_max_[i] = max(rate_max_[i], sample.rate[i]);
  }
  if (++samples_ < kCalibrationSamples) return Running;

  aligned_ = false;
  for (uint8_t i = 0; i < 3; ++i) {
    if (int32_t(rate_max_[i]) - rate_min_[i] > kStillSpread) return Moved;
  }
  for (uint8_t i = 0; i < 3; ++i) {
    offsets_.acceleration[i] = float(sum_acceleration_[i]) / samples_;
    offsets_.rate[i] = float(sum_rate_[i]) / samples_;
  }
  offsets_.acceleration[2] -= kLsbPerG;  // the car stands level: 1 g is up
  calibrated_ = true;
  store();
  return Done;
}

void Imu::load() {
  StoredOffsets stored;
  eeprom_read_block(&stored, kEepromAddress, sizeof stored);
  calibrated_ = stored.magic == kEepromMagic && stored.checksum == checksum_of(stored);
  if (calibrated_) {
    memcpy(&offsets_, stored.offsets, sizeof offsets_);
  } else {
    memset(&offsets_, 0, sizeof offsets_);
  }
}

void Imu::store() const {
  StoredOffsets stored;
  stored.magic = kEepromMagic;
  memcpy(stored.offsets, &offsets_, sizeof stored.offsets);
  stored.checksum = checksum_of(stored);
  const uint8_t* bytes = reinterpret_cast<const uint8_t*>(&stored);
  for (uint8_t i = 0; i < sizeof stored; ++i) {
    wdt_reset();  // a byte takes 3.4 ms, all of them nearly the timeout of the watchdog
    eeprom_update_byte(kEepromAddress + i, bytes[i]);
  }
}
