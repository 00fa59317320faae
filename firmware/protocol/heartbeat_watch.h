// Whether heartbeats still come, judged by when they arrived in the UART, not by when loop() read them.
//
// A loop() that was held up finds old heartbeats in the UART's buffer. They must not keep a motor running.
// So a timer interrupt notes, about once a millisecond, how many bytes have arrived; later it can be told
// how old each byte is:
//
//   ISR(TIMER0_COMPA_vect) { watch.tick(Serial.available()); if (!watch.alive()) motor_off(); }
//   ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { watch.byte_read(); byte = Serial.read(); }   // for every byte
//   ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { watch.heartbeat(); }                         // for every heartbeat
//
// Everything here is to be called with interrupts off.

#ifndef SERIAL_COMMUNICATION_HEARTBEAT_WATCH_H
#define SERIAL_COMMUNICATION_HEARTBEAT_WATCH_H

#include <stdint.h>

namespace serial_communication {

// `TimeoutTicks`: a heartbeat that so many ticks have seen is too old.
template <uint8_t TimeoutTicks>
class HeartbeatWatch {
 public:
  // `waiting`: the bytes in the UART's buffer, at most 127.
  void tick(uint8_t waiting) {
    now_ = (now_ + 1) % kTicks;
    arrived_[now_] = static_cast<uint8_t>(read_ + waiting);
    if (age_ < TimeoutTicks) ++age_;
  }

  // Together with reading one byte.
  void byte_read() { ++read_; }

  // When the byte read last was the end of a heartbeat.
  void heartbeat() {
    uint8_t age = 0;
    while (age < TimeoutTicks && seen_by(age)) ++age;
    if (age < age_) age_ = age;
  }

  bool alive() const { return age_ < TimeoutTicks; }

 private:
  static const uint8_t kTicks = 64;  // a power of two, so that positions may wrap
  static_assert(TimeoutTicks < kTicks, "the ticks of one timeout are kept");

  // Whether the byte read last had arrived at the tick so many before the last one. Counts wrap at 256.
  bool seen_by(uint8_t ticks_ago) const {
    const uint8_t arrived = arrived_[static_cast<uint8_t>(now_ - ticks_ago) % kTicks];
    return static_cast<int8_t>(arrived - read_) >= 0;
  }

  uint8_t arrived_[kTicks] = {0};
  uint8_t now_ = 0;
  uint8_t read_ = 0;
  uint8_t age_ = TimeoutTicks;
};

}  // namespace serial_communication

#endif
