// Whether heartbeats still arrive, judged by when they arrived in the UART, not by when loop() read them.
//
// A delayed loop() finds old heartbeats in the UART's buffer. They must not keep a motor running.
// So a timer interrupt, about one a millisecond, notes how many bytes have arrived; from these numbers the watch
// computes how old each byte is. With a PacketLink:
//
//   HeartbeatWatch heartbeats;
//   ISR(TIMER0_COMPA_vect) { heartbeats.tick(Serial.available()); if (!heartbeats.alive()) motor_off(); }
//   …
//   bridge.watch(heartbeats);        // in setup()
//   TIMSK0 |= _BV(OCIE0A);           // Timer0 counts millis(); its compare interrupt comes every 1.024 ms
//
// Call everything here with interrupts disabled.

#ifndef SERIAL_COMMUNICATION_HEARTBEAT_WATCH_H
#define SERIAL_COMMUNICATION_HEARTBEAT_WATCH_H

#include <stdint.h>

namespace serial_communication {

class HeartbeatWatch {
 public:
  // `timeout`: a heartbeat that arrived this number of ticks ago is too old; at most 63. The default is 30 ms at
  // 1.024 ms a tick: the first tick may follow right after a heartbeat.
  explicit HeartbeatWatch(uint8_t timeout = 31) : timeout_(timeout < kTicks ? timeout : kTicks - 1), age_(timeout_) {}

  // `waiting`: the bytes in the UART's buffer, at most 127.
  void tick(uint8_t waiting) {
    now_ = (now_ + 1) % kTicks;
    arrived_[now_] = static_cast<uint8_t>(read_ + waiting);
    if (age_ < timeout_) ++age_;
  }

  bool alive() const { return age_ < timeout_; }

  // Has to be called when one byte is read.
  void byte_read() { ++read_; }

  // Has to be called when the last byte read was the end of a heartbeat.
  void heartbeat() {
    uint8_t age = 0;
    while (age < timeout_ && seen_by(age)) ++age;
    if (age < age_) age_ = age;
  }

 private:
  static const uint8_t kTicks = 64;  // a power of two, so that positions may wrap

  // Whether the last byte read had arrived at the tick this number before the last one. Counts wrap at 256.
  bool seen_by(uint8_t ticks_ago) const {
    const uint8_t arrived = arrived_[static_cast<uint8_t>(now_ - ticks_ago) % kTicks];
    return static_cast<int8_t>(arrived - read_) >= 0;
  }

  uint8_t arrived_[kTicks] = {0};
  uint8_t now_ = 0;
  uint8_t read_ = 0;
  uint8_t timeout_;
  uint8_t age_;
};

}  // namespace serial_communication

#endif
