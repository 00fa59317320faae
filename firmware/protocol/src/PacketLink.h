// A board's link to the bridge (`arduino`): sends packets, and calls a function for each that it receives.
//
// The port belongs to it: Serial.print breaks the packet that follows. bridge.log("text") is in the bridge's log.
//
//   PacketLink bridge(Serial);
//   bridge.on<Lamp>(33, handle_lamp);      // in setup(), after Serial.begin(115200)
//   bridge.update();                       // in loop(), often
//   bridge.send(32, light);                // a packed struct
//
// See examples/Hello and examples/Car. (A variable named `link` does not compile where <unistd.h> is included,
// which has a function of that name: on an ESP32.)

#ifndef PACKETLINK_H
#define PACKETLINK_H

#include "announcer.h"
#include "arduino_packets.h"
#include "heartbeat_watch.h"
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

  explicit PacketLink(Stream& port) : PacketSender<StreamSink>(StreamSink{&port}), port_(port) {}

  // Calls `handle` for each custom message of this type (13 … 254), whose data is a T. False where the type is
  // another one or has its function, or there are kMaxHandlers; update() then reports it to the bridge, once.
  template <class T>
  bool on(uint8_t type, void (*handle)(const T&)) {
    const bool taken = decoder_.accept<T>(type);
    if (taken) {
      handlers_[handler_count_++] = {&call<T>, reinterpret_cast<void (*)()>(handle)};
    } else {
      refused_type_ = true;
    }
    return taken;
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
  }

  // Calls the functions for what was received.
  void update() {
    if (refused_type_) {
      refused_type_ = false;
      error(F("on(): a type twice, not in 13 ... 254, or one too many"));
    }
    const uint32_t now = millis();
    if (heartbeat_age() > 60000) had_heartbeat_ = false;  // before the clock wraps
    while (port_.available() > 0) {
      if (decoder_.feed(read(), now)) dispatch(decoder_.packet());
    }
    uint8_t chunk[Chunks::kMaxChunk];
    const uint8_t size = announcer_.next(port_, now, chunk);
    if (size > 0) send(MessageType::Announcement, chunk, size);
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
  typedef Announcer<16> Chunks;  // on the wire 23 bytes, so that 40 more fit into the send buffer of an AVR

  struct Handler {
    void (*call)(void (*handle)(), const uint8_t* data);
    void (*handle)();
  };

  template <class T>
  static void call(void (*handle)(), const uint8_t* data) {
    T value;
    memcpy(&value, data, sizeof value);
    reinterpret_cast<void (*)(const T&)>(handle)(value);
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
      handler.call(handler.handle, packet.data);
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
  Chunks announcer_;
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

using namespace serial_communication;

#endif
