// The sensors of the program: two distances and an attitude. The same interface on each chip.
//
// sensors_esp32.cpp uses Pololu's library for the VL53L0X, sensors_avr.cpp reads its registers itself. The
// BNO055's registers are read in the same way on both, in sensors.cpp.

#ifndef RANGE_IMU_SENSORS_H
#define RANGE_IMU_SENSORS_H

#include <stdint.h>

struct Attitude {
  int32_t yaw;    // 0.01 degree, clockwise, 0 … 35999
  int16_t pitch;  // 0.01 degree
  int16_t roll;   // 0.01 degree
};

// Starts the I2C bus.
void sensors_begin();

// One transfer on the bus; false: no device acknowledged all of it.
bool bus_write(uint8_t device, const uint8_t* bytes, uint8_t size);
bool bus_read(uint8_t device, uint8_t reg, uint8_t* out, uint8_t size);

// Resets range sensor 0 or 1 by its register, in 3 ms; false when it does not answer.
bool range_reset(uint8_t sensor);

// Whether the register RESULT_RANGE_STATUS reports a fault of the sensor: then its range is none.
bool range_error(uint8_t result_status);

// Resets and starts range sensor 0 or 1; false when it does not answer. On the ESP32 it takes up to 0.2 s.
bool range_begin(uint8_t sensor);

// Reads a finished measurement without waiting; false: there is none yet.
bool range_read(uint8_t sensor, uint16_t* millimetres);

// Starts the BNO055, or resets it if it was started and computes no angles, without waiting for it. False when it
// does not answer or was reset: then it has to be started a second later.
bool attitude_begin();

// False: the BNO055 does not answer, or computes no angles since it was just started or has lost its
// power.
bool attitude_read(Attitude* attitude);

#endif
