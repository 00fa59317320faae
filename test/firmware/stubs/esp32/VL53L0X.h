// The signatures of Pololu's library that the sensor board uses.

#ifndef STUB_VL53L0X_H
#define STUB_VL53L0X_H

#include "Arduino.h"

class VL53L0X {
 public:
  enum regAddr { RESULT_INTERRUPT_STATUS = 0x13, RESULT_RANGE_STATUS = 0x14 };

  uint8_t last_status;  // of the last I2C transmission

  VL53L0X();
  bool init(bool io_2v8 = true);
  uint8_t readReg(uint8_t reg);
  void startContinuous(uint32_t period_ms = 0);
  uint16_t readRangeContinuousMillimeters();
  void setTimeout(uint16_t timeout);
  bool timeoutOccurred();
};

#endif
