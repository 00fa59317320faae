// The I2C multiplexer in front of the two VL53L0X, which share one address.

#ifndef RANGE_IMU_TCA9548A_H
#define RANGE_IMU_TCA9548A_H

#include <stdint.h>

const uint8_t kRangeChannels[2] = {3, 6};

// False when the multiplexer does not answer.
bool tca_select(uint8_t channel);

#endif
