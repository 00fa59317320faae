// The MPU6050: orientation by a Mahony filter on the chip, and the calibration kept in EEPROM.

#ifndef NANO_CAR_IMU_H
#define NANO_CAR_IMU_H

#include <PacketLink.h>

class Imu {
 public:
  enum Calibration : uint8_t { None, Running, Done, Moved, Failed };

  // Wakes the sensor and reads the stored calibration; false when the sensor does not answer.
  bool begin();

  bool calibrated() const { return calibrated_; }

  // Reads the sensor once and turns the orientation by `seconds` of the rate. False: there was no answer, or no
  // values: a sensor that was without power for a moment is asleep, and answers with zeros.
  bool update(float seconds, ImuData* out);

  // Whether so many reads have failed in a row, 0.2 s, that begin() has to start the sensor again.
  bool lost() const;

  // The car must be level and must not move until calibrate() has returned Done or Moved.
  void start_calibration();

  // To be called every 10 ms while the calibration runs; reads the sensor once.
  Calibration calibrate();

 private:
  struct Sample {
    int16_t acceleration[3];
    int16_t temperature;
    int16_t rate[3];
  };

  struct Offsets {
    float acceleration[3];
    float rate[3];
  };

  bool read(Sample* sample);
  void load();
  void store() const;
  void align(const float acceleration[3]);
  void rotate(const float acceleration[3], const float rate[3], float seconds);

  Offsets offsets_;
  bool calibrated_;
  bool aligned_;
  float q_[4];

  // Sums of a running calibration.
  uint16_t samples_;
  uint8_t failed_reads_;  // since the last successful one
  int32_t sum_acceleration_[3];
  int32_t sum_rate_[3];
  int16_t rate_min_[3];
  int16_t rate_max_[3];
};

#endif
