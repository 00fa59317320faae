// A board's link to the bridge (`arduino`): sends packets, and calls a function for each that it receives.
//
// The port belongs to it: Serial.print breaks the packet that follows. bridge.log("text") is in the bridge's log.
//
//   PacketLink bridge(Serial);
//   bridge.on<Lamp>(33, handle_lamp);      // in setup(), after Serial.begin(115200)
//   bridge.update();                       // in loop(), often
//   bridge.time(micros());                 // when the next packets are measured: their stamps
//   bridge.send(32, light);                // a packed struct
//
// See examples/Hello and examples/Car. (A variable named `link` does not compile where <unistd.h> is included,
// which has a function of that name: on an ESP32.)

#ifndef PACKETLINK_H
#define PACKETLINK_H

#include "announcer.h"
#include "arduino_packets.h"
#include "heartbeat_watch.h"
#include "settings.h"
#include "stream_sink.h"
#if defined(__AVR__)
#include <util/atomic.h>
#endif

namespace serial_communication {

// All that PacketSender sends: custom messages, text for the log, and what the bridge publishes of a car. Each
// function returns whether the whole packet was sent.
class PacketLink : public PacketSender<StreamSink> {
 public:
  static const uint8_t kMaxHandlers = 8;
  static const size_t kMaxPacket = 64;  // bytes, the type included

  explicit PacketLink(Stream& port) : PacketSender<StreamSink>(StreamSink{&port}), port_(port), buffer_(port) {}

  // Calls `handle` for each custom message of this type (13 … 252), whose data is a T. False where the type is
  // another one or has its function, or there are kMaxHandlers; update() then reports it to the bridge, once. It also
  // reports messages that have another size, at most one a type and second.
  template <class T>
  bool on(uint8_t type, void (*handle)(const T&)) {
    return add(decoder_.accept<T>(type), &call<T>, reinterpret_cast<Function>(handle));
  }

  // Likewise with data of any length.
  bool on(uint8_t type, void (*handle)(const uint8_t* data, size_t size)) {
    return add(decoder_.accept(type, 0, kMaxPacket - 1), &call_with_bytes, reinterpret_cast<Function>(handle));
  }

  // The built-in commands. Speed: -1000 … 1000. Steering: microseconds of the servo's
  // pulse. LED: text of at most 30 characters. Calibration: of the IMU, during which the car must not move.
  void on_speed(void (*handle)(int16_t speed)) { speed_ = handle; }
  void on_steering(void (*handle)(uint16_t pulse_us)) { steering_ = handle; }
  void on_led(void (*handle)(const char* text)) { led_ = handle; }
  void on_calibration(void (*handle)()) { calibration_ = handle; }

  // Announces rows to the bridge, in update(): see announcer.h. `text` is an array in program memory (PROGMEM).
  template <size_t Size>
  void announce(const char (&text)[Size]) {
    announcer_.begin(text);
    if (!send_regularly_) send_regularly_ = &send_chunk;
  }

  // Lets the bridge change and show settings, in update(): see settings.h. `table` is an array in program memory.
  // `changed` is called with the number of one that has another value. They take the place of one function of on();
  // false where that is missing.
  template <size_t Count>
  bool settings(const Setting (&table)[Count], void (*changed)(uint8_t number) = 0) {
    settings_.begin(table, changed);
    send_regularly_ = &send_chunk_and_setting;
    if (!decoder_.accept_settings()) {
      refused_type_ = true;
      return false;
    }
    Handler& handler = handlers_[handler_count_++];
    handler.call = &take_setting;
    handler.target.settings = &settings_;
    return true;
  }

  // Calls the functions for what was received: at most 64 bytes a call, and nothing here waits for room to send. So
  // loop() goes on whatever the line brings. A function that answers bad input limits how often: see rate_limit.h.
  void update() {
    const uint32_t now = millis();
    if (heartbeat_age() > 60000) had_heartbeat_ = false;  // before the clock wraps
    for (uint8_t left = kMaxReadAtOnce;; --left) {
      if (report_) report_(*this, now);
      if (left == 0) break;
      if (port_.available() <= 0) {
        decoder_.poll(now);
        break;
      }
      if (decoder_.feed(read(), now)) dispatch(decoder_.packet());
    }
    if (send_regularly_) send_regularly_(*this, now);
  }

  // A line in the bridge's log.
  bool log(const char* text) { return info(text); }
  bool log(const __FlashStringHelper* text) { return info(text); }
  bool info(const char* text) { return send_text(MessageType::Info, text); }
  bool warn(const char* text) { return send_text(MessageType::Warn, text); }
  bool error(const char* text) { return send_text(MessageType::Error, text); }
  bool info(const __FlashStringHelper* text) { return send_flash_text(MessageType::Info, text); }
  bool warn(const __FlashStringHelper* text) { return send_flash_text(MessageType::Warn, text); }
  bool error(const __FlashStringHelper* text) { return send_flash_text(MessageType::Error, text); }

  // Milliseconds since update() read the last heartbeat; 0xFFFFFFFF where there was none for a minute. A delayed
  // loop() reads old ones, so use watch() for a motor on an AVR.
  uint32_t heartbeat_age() const { return had_heartbeat_ ? millis() - heartbeat_ms_ : 0xFFFFFFFF; }

#if defined(__AVR__)
  // The watch learns when heartbeats arrive. Its tick() has to be called by a timer interrupt.
  void watch(HeartbeatWatch& watch) { watch_ = &watch; }
#endif

 private:
  typedef Announcer<16, 3> Chunks;  // on the wire 23 bytes, so that 40 more fit into the send buffer of an AVR
  typedef void (*Function)();
  union Target {
    Function function;
    SettingsTable* settings;
  };
  typedef void (*Call)(Target target, const uint8_t* data, size_t size);
  static const uint8_t kMaxWarning = 60;     // bytes on the wire
  static const uint8_t kSettingSize = SettingsTable::kMaxData + 3;  // type, COBS, 0x00

  struct Handler {
    Call call;
    Target target;
  };

  template <class T>
  static void call(Target target, const uint8_t* data, size_t size) {
    reinterpret_cast<void (*)(const T&)>(target.function)(from_received<T>(data, size));
  }

  static void call_with_bytes(Target target, const uint8_t* data, size_t size) {
    reinterpret_cast<void (*)(const uint8_t*, size_t)>(target.function)(data, size);
  }

  static void take_setting(Target target, const uint8_t* data, size_t size) { target.settings->take(data, size); }

  bool add(bool accepted, Call caller, Function handle) {
    if (accepted) {
      handlers_[handler_count_++] = {caller, {handle}};
    } else {
      refused_type_ = true;
    }
    report_ = &report;
    return accepted;
  }

  // Returns whether one was due, also where nothing is announced.
  static bool send_chunk(PacketLink& link, uint32_t now) {
    if (!link.announcer_.is_due(link.buffer_, now)) return false;
    uint8_t chunk[Chunks::kMaxChunk];
    const uint8_t size = link.announcer_.next(chunk);
    if (size > 0) link.send(MessageType::Announcement, chunk, size);
    return true;
  }

  static bool send_chunk_and_setting(PacketLink& link, uint32_t now) {
    const bool due = send_chunk(link, now);
    if (due) link.settings_.report_one();
    uint8_t setting[SettingsTable::kMaxData];
    const uint8_t room = due ? kSettingSize : kSettingSize + SettingsTable::kLeftFree;
    const uint8_t size = link.settings_.next(link.buffer_, room, setting);
    if (size > 0) link.send(MessageType::Setting, setting, size);
    return due;
  }

  static void report(PacketLink& link, uint32_t now) {
    const bool wrong_size = link.decoder_.counters.wrong_length != link.wrong_lengths_;
    link.wrong_lengths_ = link.decoder_.counters.wrong_length;
    char text[kMaxWarning];
    char* end = text;
    if (wrong_size) {
      uint8_t most;
      const Packet* packet = link.decoder_.wrong_packet(&most);
      if (!packet || !link.may_warn(packet->custom, static_cast<uint8_t>(now >> 10))) return;
      end = append(append(end, F("command ")), static_cast<uint8_t>(packet->type));
      end = append(append(end, F(" has ")), static_cast<uint8_t>(packet->size));
      end = append(append(end, F(" bytes, its struct ")), most);
    } else if (link.refused_type_ && link.buffer_.has_room(kMaxWarning)) {
      link.refused_type_ = false;
      end = append(end, F("on(): a type twice, not in 13 ... 252, or one too many"));
    }
    if (end != text) link.send(wrong_size ? MessageType::Warn : MessageType::Error, text, end + 1 - text);
  }

  // `second`: of 1.024 s. In each, there is one warning for a handler.
  bool may_warn(uint8_t handler, uint8_t second) {
    if (second != warned_second_) warned_ = 0;
    warned_second_ = second;
    const uint8_t bit = static_cast<uint8_t>(1 << handler);
    if ((warned_ & bit) || !buffer_.has_room(kMaxWarning)) return false;
    warned_ |= bit;
    return true;
  }

  static char* append(char* at, const __FlashStringHelper* text) {
    const char* from = reinterpret_cast<const char*>(text);
    while ((*at = static_cast<char>(pgm_read_byte(from++))) != 0) ++at;
    return at;
  }

  static char* append(char* at, uint8_t number) {
    if (number >= 10) at = append(at, static_cast<uint8_t>(number / 10));
    *at++ = static_cast<char>('0' + number % 10);
    *at = 0;
    return at;
  }

  uint8_t read() {
#if defined(__AVR__)
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
      if (watch_) watch_->byte_read();
      return static_cast<uint8_t>(port_.read());
    }
#endif
    return static_cast<uint8_t>(port_.read());
  }

  void dispatch(const Packet& packet) {
    if (packet.custom < handler_count_) {
      const Handler& handler = handlers_[packet.custom];
      handler.call(handler.target, packet.data, packet.size);
    } else if (packet.type == MessageType::Heartbeat) {
      handle_heartbeat();
    } else if (packet.type == MessageType::SpeedCmd && speed_) {
      speed_(packet.speed());
    } else if (packet.type == MessageType::SteeringCmd && steering_) {
      steering_(packet.value());
    } else if (packet.type == MessageType::LedCmd && led_) {
      char text[kLedTextMax + 2];
      memcpy(text, packet.data, packet.size);
      text[packet.size] = 0;
      led_(text);
    } else if (packet.type == MessageType::ImuCalibration && calibration_) {
      calibration_();
    }
  }

  void handle_heartbeat() {
    if (heartbeat_age() > 100) announcer_.hurry();
    heartbeat_ms_ = millis();
    had_heartbeat_ = true;
#if defined(__AVR__)
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
      if (watch_) watch_->heartbeat();
    }
#endif
  }

  bool send_flash_text(MessageType severity, const __FlashStringHelper* text) {
    const char* from = reinterpret_cast<const char*>(text);
    char buffer[kMaxPacket - 1];
    size_t size = 0;
    do {
      buffer[size] = static_cast<char>(pgm_read_byte(from + size));
    } while (buffer[size] != 0 && ++size < sizeof buffer - 1);
    buffer[size] = 0;
    return send_text(severity, buffer);
  }

  Stream& port_;
  SendBuffer buffer_;
  Chunks announcer_;
  SettingsTable settings_;
  // So that only a sketch that announces, has settings, or takes custom messages, has the code.
  bool (*send_regularly_)(PacketLink&, uint32_t now) = 0;
  void (*report_)(PacketLink&, uint32_t now) = 0;
  uint16_t wrong_lengths_ = 0;  // that have been reported
  uint8_t warned_second_ = 0;
  uint8_t warned_ = 0;  // a bit for each handler: warned in this second
  PacketDecoder<kMaxPacket, kMaxHandlers> decoder_;
  Handler handlers_[kMaxHandlers];
  uint8_t handler_count_ = 0;
  bool refused_type_ = false;
  bool had_heartbeat_ = false;
  uint32_t heartbeat_ms_ = 0;
  void (*speed_)(int16_t) = 0;
  void (*steering_)(uint16_t) = 0;
  void (*led_)(const char*) = 0;
  void (*calibration_)() = 0;
#if defined(__AVR__)
  HeartbeatWatch* watch_ = 0;
#endif
};

}  // namespace serial_communication

// Only these names need no serial_communication:: in a sketch; others, such as Packet, are free for its own.
using serial_communication::ImuData;
using serial_communication::PacketLink;
#if defined(__AVR__)
using serial_communication::HeartbeatWatch;
#endif

#endif
