// An I2C device that is a table of registers: the first byte written chooses one, then they count up.

#ifndef EMULATOR_I2C_REGISTERS_H
#define EMULATOR_I2C_REGISTERS_H

#include <cstdint>
#include <cstring>

#include "mcu.h"

class I2cRegisters : public I2cDevice {
 public:
  bool start(bool read) override {
    if (!present) return false;
    if (read) {
      before_read(pointer_);
    } else {
      pointer_is_next_ = true;
    }
    return true;
  }

  void write(uint8_t byte) override {
    if (pointer_is_next_) {
      pointer_ = byte;
      pointer_is_next_ = false;
    } else {
      registers_[pointer_] = byte;
      written(pointer_++, byte);
    }
  }

  uint8_t read() override { return registers_[pointer_++]; }

  void power_on() override {
    memset(registers_, 0, sizeof registers_);
    defaults();
  }

  // Whether the device answers its address. Without it, it has no power.
  double present = 1;
  void set_present(double now_present) {
    if (present == 0 && now_present != 0) power_on();
    present = now_present;
  }

 protected:
  // Fills the registers as they are after power-on.
  virtual void defaults() = 0;
  // Updates the registers before a read that begins at `pointer`.
  virtual void before_read(uint8_t pointer) = 0;
  virtual void written(uint8_t, uint8_t) {}

  void put_uint16_be(uint8_t reg, uint16_t value) {
    registers_[reg] = uint8_t(value >> 8);
    registers_[reg + 1] = uint8_t(value);
  }

  void put_uint16_le(uint8_t reg, uint16_t value) {
    registers_[reg] = uint8_t(value);
    registers_[reg + 1] = uint8_t(value >> 8);
  }

  uint8_t registers_[256];

 private:
  uint8_t pointer_ = 0;
  bool pointer_is_next_ = false;
};

#endif
