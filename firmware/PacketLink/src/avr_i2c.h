// The I2C master of an AVR, without interrupts and with a bound on each wait.
//
// Arduino's Wire waits for a stop condition inside its interrupt, where everything else waits with it, and
// it cannot free a bus whose SDA a device holds low. A device does that when the chip was reset in the
// middle of a read: it waits for the clocks of its byte. Nine clocks free it.
//
// A transfer takes at most kI2cTimeoutUs and the time of nine clocks, and interrupts stay enabled.

#ifndef SERIAL_COMMUNICATION_AVR_I2C_H
#define SERIAL_COMMUNICATION_AVR_I2C_H

#include <Arduino.h>

namespace serial_communication {

const uint32_t kI2cClock = 400000;
const uint16_t kI2cTimeoutUs = 3000;

inline void i2c_pull_low(uint8_t pin) {
  digitalWrite(pin, LOW);  // before the pin is an output: it must not drive high
  pinMode(pin, OUTPUT);
}

inline void i2c_release(uint8_t pin) { pinMode(pin, INPUT_PULLUP); }

inline bool i2c_lines_high() { return digitalRead(SDA) && digitalRead(SCL); }

// Clocks a device out of its byte and ends with a stop condition. False: a line is still low.
inline bool i2c_free_bus() {
  TWCR = 0;
  i2c_release(SDA);
  for (uint8_t clocks = 9; clocks > 0 && !digitalRead(SDA); --clocks) {
    i2c_pull_low(SCL);
    delayMicroseconds(5);
    i2c_release(SCL);
    delayMicroseconds(5);
  }
  i2c_pull_low(SCL);
  i2c_pull_low(SDA);
  delayMicroseconds(5);
  i2c_release(SCL);
  delayMicroseconds(5);
  i2c_release(SDA);
  delayMicroseconds(5);
  return i2c_lines_high();
}

// False: a line is held low; transfers try again to free it.
inline bool i2c_begin() {
  i2c_release(SCL);
  TWSR = 0;
  TWBR = (F_CPU / kI2cClock - 16) / 2;
  return i2c_free_bus();
}

// One step of the hardware. False: it did not end by the deadline, or not with `status`.
inline bool i2c_step(uint8_t control, uint8_t status, uint32_t start_us) {
  TWCR = control | _BV(TWINT) | _BV(TWEN);
  while (!(TWCR & _BV(TWINT))) {
    if (micros() - start_us > kI2cTimeoutUs) return false;
  }
  return (TWSR & 0xF8) == status;
}

inline bool i2c_stop(uint32_t start_us) {
  TWCR = _BV(TWINT) | _BV(TWEN) | _BV(TWSTO);
  while (TWCR & _BV(TWSTO)) {
    if (micros() - start_us > kI2cTimeoutUs) return false;
  }
  return true;
}

// Writes `out`, then reads `in`; either may be empty, but not both. False: no device answered all of it.
inline bool i2c_transfer(uint8_t device, const uint8_t* out, uint8_t out_size, uint8_t* in, uint8_t in_size) {
  if (!i2c_lines_high() && !i2c_free_bus()) return false;
  const uint32_t start = micros();
  const uint8_t kStarted = 0x08, kStartedAgain = 0x10;
  const uint8_t kWriteAcknowledged = 0x18, kByteAcknowledged = 0x28, kReadAcknowledged = 0x40;
  const uint8_t kByteRead = 0x50, kLastByteRead = 0x58;
  bool done = true;
  if (out_size > 0) {
    done = i2c_step(_BV(TWSTA), kStarted, start);
    TWDR = device << 1;
    done = done && i2c_step(0, kWriteAcknowledged, start);
    for (uint8_t i = 0; done && i < out_size; ++i) {
      TWDR = out[i];
      done = i2c_step(0, kByteAcknowledged, start);
    }
  }
  if (done && in_size > 0) {
    done = i2c_step(_BV(TWSTA), out_size > 0 ? kStartedAgain : kStarted, start);
    TWDR = device << 1 | 1;
    done = done && i2c_step(0, kReadAcknowledged, start);
    for (uint8_t i = 0; done && i < in_size; ++i) {
      const bool last = i + 1 == in_size;
      done = i2c_step(last ? 0 : _BV(TWEA), last ? kLastByteRead : kByteRead, start);
      in[i] = TWDR;
    }
  }
  if (!i2c_stop(start)) {
    i2c_free_bus();
    return false;
  }
  return done;
}

inline bool i2c_write_register(uint8_t device, uint8_t reg, uint8_t value) {
  const uint8_t bytes[2] = {reg, value};
  return i2c_transfer(device, bytes, sizeof bytes, 0, 0);
}

inline bool i2c_read_registers(uint8_t device, uint8_t reg, uint8_t* out, uint8_t size) {
  return i2c_transfer(device, &reg, 1, out, size);
}

}  // namespace serial_communication

using serial_communication::i2c_begin;
using serial_communication::i2c_read_registers;
using serial_communication::i2c_transfer;
using serial_communication::i2c_write_register;

#endif
