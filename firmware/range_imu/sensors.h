// What the program needs of its sensors: two distances and an attitude, on whichever chip it runs.
//
// sensors_esp32.cpp uses the libraries of Pololu (VL53L0X) and Adafruit (BNO055);
// sensors_avr.cpp reads the registers itself.

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

// Starts range sensor 0 or 1; false when it does not answer.
bool range_begin(uint8_t sensor);

// Takes a finished measurement, without waiting for one; false when there is none yet.
bool range_read(uint8_t sensor, uint16_t* millimetres);

// Starts the BNO055; false when it does not answer.
bool attitude_begin();

bool attitude_read(Attitude* attitude);

#endif
