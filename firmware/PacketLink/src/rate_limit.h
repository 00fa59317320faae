// Limits how often something is said: bad input may come a thousand times a second.
//
//   static RateLimit limit;      // one a second
//   if (limit.passes(millis())) bridge.warn(F("unknown command"));

#ifndef SERIAL_COMMUNICATION_RATE_LIMIT_H
#define SERIAL_COMMUNICATION_RATE_LIMIT_H

#include <stdint.h>

namespace serial_communication {

class RateLimit {
 public:
  explicit RateLimit(uint16_t period_ms = 1000) : period_ms_(period_ms), passed_ms_(0ul - period_ms) {}

  // True at the first call, and then when the period has passed since it was true.
  bool passes(uint32_t now_ms) {
    if (now_ms - passed_ms_ < period_ms_) return false;
    passed_ms_ = now_ms;
    return true;
  }

 private:
  uint16_t period_ms_;
  uint32_t passed_ms_;
};

}  // namespace serial_communication

using serial_communication::RateLimit;

#endif
