// An SHT3x, measured repeatedly without waiting for it. After a read that fails it is reset.

#ifndef CTRL_BOARD_SHT3X_H
#define CTRL_BOARD_SHT3X_H

#include <stdint.h>

class Sht3x {
 public:
  // Has to be called often.
  void poll(uint32_t now_ms);

  // Whether the last reading was at most two seconds old at the last poll().
  bool valid() const { return measured_; }

  int16_t temperature() const { return temperature_; }  // 0.01 degree Celsius
  uint16_t humidity() const { return humidity_; }       // 0.01 %

 private:
  bool start();
  bool fetch();

  bool measuring_ = false;
  bool measured_ = false;
  uint32_t started_ms_ = 0;
  uint32_t measured_ms_ = 0;
  int16_t temperature_ = 0;
  uint16_t humidity_ = 0;
};

#endif
