// The world of the range board: two VL53L0X behind a TCA9548A, and a BNO055.

#include <cmath>

#include "i2c_registers.h"
#include "world.h"

namespace {

const int kChannels[2] = {3, 6};  // of the TCA9548A

// Only what continuous ranging needs after initialisation: start, ready, result, clear, and a reset.
class Vl53l0x : public I2cRegisters {
 public:
  explicit Vl53l0x(Mcu& mcu) : mcu_(mcu) { power_on(); }

  double range = 800;  // mm
  double alive = 1;    // 0: answers, but finishes no measurement
  double error = 0;    // the code that its results have instead of 11, "complete", until it is reset

 protected:
  void defaults() override {
    registers_[0xC0] = 0xEE;
    registers_[0xC1] = 0xAA;
    next_ready_ = INFINITY;
  }

  void before_read(uint8_t pointer) override {
    if (pointer == 0x13) registers_[0x13] = alive != 0 && mcu_.seconds() >= next_ready_ ? 4 : 0;
    if (pointer == 0x14) registers_[0x14] = uint8_t((error != 0 ? error : 11)) << 3;
    if (pointer == 0x1E) put_uint16_be(0x1E, uint16_t(std::lround(range)));
  }

  void written(uint8_t reg, uint8_t value) override {
    if (reg == 0xBF && value == 0) {
      power_on();
      error = 0;
    }
    if (reg == 0x00 && value == 0x02) next_ready_ = mcu_.seconds() + kTimingBudget;
    if (reg == 0x0B && (value & 1) && std::isfinite(next_ready_)) next_ready_ = mcu_.seconds() + kTimingBudget;
  }

 private:
  static constexpr double kTimingBudget = 0.033;
  Mcu& mcu_;
  double next_ready_ = INFINITY;
};

// Identity, mode, status, reset and Euler angles. Without power it forgets its mode, and its angles are 0.
class Bno055 : public I2cRegisters {
 public:
  explicit Bno055(Mcu& mcu) : mcu_(mcu) { power_on(); }

  bool start(bool read) override { return mcu_.seconds() >= boots_until_ && I2cRegisters::start(read); }

  double error = 0;    // 1: a system error, which only a reset ends
  double heading = 0;  // degrees, clockwise
  double pitch = 0, roll = 0;

 protected:
  void defaults() override {
    registers_[0x00] = 0xA0;
    fusion_at_ = INFINITY;
  }

  void before_read(uint8_t pointer) override {
    const bool fusing = error == 0 && mcu_.seconds() >= fusion_at_;
    registers_[0x39] = error != 0 ? 1 : fusing ? 5 : 0;
    if (pointer != 0x1A || !fusing) return;
    const double turns = std::floor(heading / 360);
    put_uint16_le(0x1A, sixteenths(heading - 360 * turns));
    put_uint16_le(0x1C, sixteenths(pitch));
    put_uint16_le(0x1E, sixteenths(roll));
  }

  void written(uint8_t reg, uint8_t value) override {
    if (reg == 0x3F && (value & 0x20)) {
      power_on();
      error = 0;
      boots_until_ = mcu_.seconds() + kBootsIn;
    }
    if (reg == 0x3D) fusion_at_ = value == 0x0C ? mcu_.seconds() + kStartsIn : INFINITY;
  }

 private:
  static constexpr double kStartsIn = 0.02, kBootsIn = 0.65;
  Mcu& mcu_;
  double boots_until_ = 0;
  double fusion_at_ = INFINITY;

  static uint16_t sixteenths(double degrees) { return uint16_t(int16_t(std::lround(degrees * 16))); }
};

// Forwards transfers to address 0x29 to the sensors of the enabled channels.
class Tca9548a : public I2cDevice {
 public:
  bool start(bool) override { return true; }
  void write(uint8_t byte) override { mask = byte; }
  uint8_t read() override { return mask; }
  void power_on() override { mask = 0; }

  uint8_t mask = 0;
};

class BehindTca : public I2cDevice {
 public:
  BehindTca(const Tca9548a& tca, Vl53l0x& first, Vl53l0x& second) : tca_(tca), sensors_{&first, &second} {}

  bool start(bool read) override {
    selected_ = nullptr;
    for (int i = 0; i < 2; ++i) {
      if (tca_.mask >> kChannels[i] & 1) selected_ = sensors_[i];
    }
    return selected_ != nullptr && selected_->start(read);
  }
  void write(uint8_t byte) override { selected_->write(byte); }
  uint8_t read() override { return selected_->read(); }
  void power_on() override {
    for (Vl53l0x* sensor : sensors_) sensor->power_on();
  }

 private:
  const Tca9548a& tca_;
  Vl53l0x* sensors_[2];
  Vl53l0x* selected_ = nullptr;
};

class RangeWorld : public World {
 public:
  RangeWorld(Mcu& mcu, bool still)
      : mcu_(mcu),
        range_{Vl53l0x(mcu), Vl53l0x(mcu)},
        behind_(tca_, range_[0], range_[1]),
        bno055_(mcu) {
    values.clock = [this] { return mcu_.seconds(); };
    mcu.attach_i2c(0x70, &tca_);
    mcu.attach_i2c(0x29, &behind_);
    mcu.attach_i2c(0x28, &bno055_);
    for (int i = 0; i < 2; ++i) {
      const std::string name = "range" + std::to_string(i + 1);
      values.variable(name, &range_[i].range);
      values.variable(name + "_alive", &range_[i].alive);
      values.variable(name + "_error", &range_[i].error);
      values.variable(name + "_present", [this, i] { return range_[i].present; },
                      [this, i](double present) { range_[i].set_present(present); });
    }
    values.variable("heading", &bno055_.heading);
    values.variable("pitch", &bno055_.pitch);
    values.variable("roll", &bno055_.roll);
    values.variable("bno055_error", &bno055_.error);
    values.variable("bno055_present", [this] { return bno055_.present; },
                    [this](double present) { bno055_.set_present(present); });
    if (!still) mcu.every(uint64_t(0.005 * mcu.frequency()), [this] { move(); });
  }

 private:
  void move() {
    const double now = mcu_.seconds();
    range_[0].range = wave(now, 8, 200, 1200);
    range_[1].range = wave(now + 3, 11, 150, 900);
    bno055_.heading = std::fmod(now * 12, 360);
    bno055_.pitch = wave(now, 7, -5, 5);
    bno055_.roll = wave(now, 9, -8, 8);
  }

  Mcu& mcu_;
  Tca9548a tca_;
  Vl53l0x range_[2];
  BehindTca behind_;
  Bno055 bno055_;
};

}  // namespace

std::unique_ptr<World> make_range_world(Mcu& mcu, bool still) {
  return std::unique_ptr<World>(new RangeWorld(mcu, still));
}
