// The sensors on an ESP32, through the libraries VL53L0X (Pololu) and Adafruit BNO055.
// Written against the libraries' documented interface; it has not been compiled or run with the
// ESP32 toolchain, and no ESP32 is emulated here.

#if defined(ARDUINO_ARCH_ESP32)

#include <Adafruit_BNO055.h>
#include <VL53L0X.h>
#include <Wire.h>
#include <math.h>

#include "sensors.h"
#include "tca9548a.h"

static VL53L0X ranges[2];
static Adafruit_BNO055 bno(55, 0x28);

void sensors_begin() {
  Wire.begin(21, 22);
  Wire.setClock(400000);
}

bool range_begin(uint8_t sensor) {
  if (!tca_select(kRangeChannels[sensor])) return false;
  ranges[sensor].setTimeout(50);
  if (!ranges[sensor].init()) return false;
  ranges[sensor].startContinuous();
  return true;
}

bool range_read(uint8_t sensor, uint16_t* millimetres) {
  if (!tca_select(kRangeChannels[sensor])) return false;
  // The library's read waits for a measurement: it is called only once there is one.
  if ((ranges[sensor].readReg(VL53L0X::RESULT_INTERRUPT_STATUS) & 0x07) == 0) return false;
  *millimetres = ranges[sensor].readRangeContinuousMillimeters();
  return !ranges[sensor].timeoutOccurred();
}

bool attitude_begin() {
  if (!bno.begin()) return false;
  bno.setExtCrystalUse(true);
  return true;
}

bool attitude_read(Attitude* attitude) {
  const imu::Vector<3> euler = bno.getVector(Adafruit_BNO055::VECTOR_EULER);
  attitude->yaw = lround(euler.x() * 100);
  attitude->pitch = int16_t(lround(euler.y() * 100));
  attitude->roll = int16_t(lround(euler.z() * 100));
  return true;
}

#endif
