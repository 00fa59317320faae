// The packets between the robot computer and the model car's Arduino: types, sender, decoder.
//
//   | COBS of: message type (1 byte), data | 0x00 |
//
// Little-endian, except IMU data, whose eleven int16 are big-endian. No checksum.
//
// PacketLink.h uses this; a sketch includes that one. Bytes are sent through a sink, any callable
// (const uint8_t* bytes, size_t size) that returns whether it accepted them all: one call a packet.

#ifndef SERIAL_COMMUNICATION_ARDUINO_PACKETS_H
#define SERIAL_COMMUNICATION_ARDUINO_PACKETS_H

#include <string.h>

#include "cobs.h"
#include "packed.h"

namespace serial_communication {

enum class MessageType : uint8_t {
  Debug = 0,
  Info = 1,
  Warn = 2,
  Error = 3,
  SpeedCmd = 4,         // to the board: int16, -1000 … 1000
  SteeringCmd = 5,      // to the board: uint16, microseconds of the servo pulse
  LedCmd = 6,           // to the board: text and a 0x00
  SteeringAngle = 7,    // from the board: uint16, 0 … 1024
  Ticks = 8,            // from the board: uint8, encoder ticks in the last 0.01 s
  Imu = 9,              // from the board: ImuData
  Voltage = 10,         // from the board: float32, V, averaged over 3 s
  Heartbeat = 11,       // to the board: no data
  ImuCalibration = 12,  // to the board: no data
  Setting = 253,        // both ways: uint8, number, and its value
  Time = 254,           // from the board: uint32, microseconds, and uint8: of how many packets that follow
  Announcement = 255,   // from the board: a chunk of its rows' text
};

const uint8_t kMessageTypes = 13;     // the first type of custom messages
const uint8_t kLastCustomType = 252;
const uint8_t kMostTimedPackets = 16;

constexpr bool is_custom_type(uint8_t type) {
  return type >= kMessageTypes && type <= kLastCustomType;
}

const uint8_t kImuDataSize = 22;
const uint8_t kLedTextMax = 30;
const int16_t kSpeedMax = 1000;

// IMU data in the board's own axes and the wire's units.
struct ImuData {
  int16_t quaternion[4];        // w, x, y, z; 1/16384
  int16_t angular_velocity[3];  // x, y, z; 4000/65536 * 25 degrees per second
  int16_t acceleration[3];      // x, y, z; 8/65536 g
  int16_t temperature;          // raw/340 + 36.53 degrees Celsius
};

inline void imu_to_bytes(const ImuData& imu, uint8_t* out) {
  const int16_t fields[11] = {imu.quaternion[0],       imu.quaternion[1],       imu.quaternion[2],
                              imu.quaternion[3],       imu.angular_velocity[0], imu.angular_velocity[1],
                              imu.angular_velocity[2], imu.acceleration[0],     imu.acceleration[1],
                              imu.acceleration[2],     imu.temperature};
  for (uint8_t i = 0; i < 11; ++i) {
    const uint16_t value = static_cast<uint16_t>(fields[i]);
    out[2 * i] = static_cast<uint8_t>(value >> 8);
    out[2 * i + 1] = static_cast<uint8_t>(value);
  }
}

inline void imu_from_bytes(const uint8_t* in, ImuData* imu) {
  int16_t fields[11];
  for (uint8_t i = 0; i < 11; ++i) {
    fields[i] = static_cast<int16_t>(static_cast<uint16_t>(in[2 * i]) << 8 | in[2 * i + 1]);
  }
  memcpy(imu->quaternion, fields, sizeof imu->quaternion);
  memcpy(imu->angular_velocity, fields + 4, sizeof imu->angular_velocity);
  memcpy(imu->acceleration, fields + 7, sizeof imu->acceleration);
  imu->temperature = fields[10];
}

// Sends packets of any type. `MaxData` bounds the data of one packet: longer text is cut, longer data of
// another type is not sent. Each function returns whether the whole packet was sent.
template <class Sink, size_t MaxData = 63>
class PacketSender {
 public:
  explicit PacketSender(Sink sink) : sink_(sink) {}

  bool send(MessageType type, const void* data, size_t size) {
    if (size > MaxData) {
      if (type > MessageType::Error && type != MessageType::LedCmd) return false;
      size = MaxData;
    }
    uint8_t packet[1 + MaxData];
    uint8_t wire[cobs_encoded_max(1 + MaxData) + 1];
    packet[0] = static_cast<uint8_t>(type);
    if (size > 0) memcpy(packet + 1, data, size);
    size_t length = cobs_encode(packet, 1 + size, wire);
    wire[length++] = 0;
    return sink_(static_cast<const uint8_t*>(wire), length);
  }

  // A custom message: any packed struct. False also where the type (13 … 252) is not that of a custom message.
  template <class T>
  bool send(uint8_t type, const T& value) {
    check_can_cross_the_wire<T>();
    static_assert(sizeof(T) <= MaxData, "a packet of this sender holds no more");
    return is_custom_type(type) && send(static_cast<MessageType>(type), &value, sizeof value);
  }

  // Likewise with data of any length.
  bool send(uint8_t type, const void* data, size_t size) {
    return is_custom_type(type) && send(static_cast<MessageType>(type), data, size);
  }

  // Text of a log message (Debug … Error) or an LED command; its 0x00 is sent too.
  bool send_text(MessageType type, const char* text) { return send(type, text, strlen(text) + 1); }

  bool send_speed(int16_t speed) { return send_uint16(MessageType::SpeedCmd, static_cast<uint16_t>(speed)); }
  bool send_steering(uint16_t pulse_us) { return send_uint16(MessageType::SteeringCmd, pulse_us); }
  bool send_steering_angle(uint16_t raw) { return send_uint16(MessageType::SteeringAngle, raw); }
  bool send_ticks(uint8_t ticks) { return send(MessageType::Ticks, &ticks, 1); }
  bool send_heartbeat() { return send(MessageType::Heartbeat, 0, 0); }
  bool send_imu_calibration() { return send(MessageType::ImuCalibration, 0, 0); }

  bool send_imu(const ImuData& imu) {
    uint8_t data[kImuDataSize];
    imu_to_bytes(imu, data);
    return send(MessageType::Imu, data, sizeof data);
  }

  // Tells when the next packets were measured: their topics have the stamp of that moment. Packets of log text and of
  // announcements are not counted. Another time() ends the reach of this one. Does nothing with NO_BOARD_TIME.
  //
  // Args: microseconds, by micros(), read when the first of them is measured; how many packets, 1 … 16.
  bool time(uint32_t microseconds, uint8_t packets = kMostTimedPackets) {
#ifdef NO_BOARD_TIME
    (void)microseconds;
    (void)packets;
    return true;
#else
    const uint8_t data[5] = {static_cast<uint8_t>(microseconds), static_cast<uint8_t>(microseconds >> 8),
                             static_cast<uint8_t>(microseconds >> 16), static_cast<uint8_t>(microseconds >> 24),
                             packets};
    return send(MessageType::Time, data, sizeof data);
#endif
  }

  bool send_voltage(float volts) {
    static_assert(sizeof(float) == 4, "the wire carries an IEEE 754 float32");
    uint32_t bits;
    memcpy(&bits, &volts, 4);
    const uint8_t data[4] = {static_cast<uint8_t>(bits), static_cast<uint8_t>(bits >> 8),
                             static_cast<uint8_t>(bits >> 16), static_cast<uint8_t>(bits >> 24)};
    return send(MessageType::Voltage, data, sizeof data);
  }

 private:
  bool send_uint16(MessageType type, uint16_t value) {
    const uint8_t data[2] = {static_cast<uint8_t>(value), static_cast<uint8_t>(value >> 8)};
    return send(type, data, sizeof data);
  }

  Sink sink_;
};

// One valid packet: a known type with its length, or a custom message.
struct Packet {
  MessageType type;
  const uint8_t* data;  // valid until the decoder's next feed()
  size_t size;
  uint8_t custom;       // of a custom message: which of the accepted types, from 0; else 255

  uint16_t value() const { return static_cast<uint16_t>(data[0] | static_cast<uint16_t>(data[1]) << 8); }

  // The speed command, saturated.
  int16_t speed() const {
    const int16_t raw = static_cast<int16_t>(value());
    return raw > kSpeedMax ? kSpeedMax : raw < -kSpeedMax ? -kSpeedMax : raw;
  }

  float voltage() const {
    const uint32_t bits = static_cast<uint32_t>(data[0]) | static_cast<uint32_t>(data[1]) << 8 |
                          static_cast<uint32_t>(data[2]) << 16 | static_cast<uint32_t>(data[3]) << 24;
    float volts;
    memcpy(&volts, &bits, 4);
    return volts;
  }

  // A custom message of this type; false where it is another one or has another size.
  template <class T>
  bool is(uint8_t custom_type, T* value) const {
    return static_cast<uint8_t>(type) == custom_type && from_bytes(data, size, value);
  }

  ImuData imu() const {
    ImuData imu;
    imu_from_bytes(data, &imu);
    return imu;
  }

  // Compares a text packet; the closing 0x00 may be there or not.
  bool text_is(const char* text) const {
    const size_t length = size > 0 && data[size - 1] == 0 ? size - 1 : size;
    return strlen(text) == length && memcmp(text, data, length) == 0;
  }
};

// Takes bytes one by one and yields valid packets. `MaxPacket` bounds the decoded packet,
// type byte included; a longer one is dropped whole. `MaxCustom` bounds the types of custom messages.
template <size_t MaxPacket = 256, uint8_t MaxCustom = 4>
class PacketDecoder {
 public:
  // Why packets were dropped.
  struct Counters {
    uint16_t cobs_errors;
    uint16_t too_long;
    uint16_t wrong_length;
    uint16_t unknown_type;
    uint16_t timeouts;
  };

  explicit PacketDecoder(uint32_t frame_timeout_ms = 50) : counters(), frame_timeout_ms_(frame_timeout_ms) {}

  // Takes custom messages of this type (13 … 252), whose data is a T. False: it does so already, the type is
  // another one, or there are MaxCustom.
  template <class T>
  bool accept(uint8_t type) {
    check_can_cross_the_wire<T>();
    static_assert(sizeof(T) < MaxPacket && sizeof(T) <= 255, "a packet of this decoder holds no more");
    return accept(type, LeastSize<T>::value, sizeof(T));
  }

  // Likewise those with `least` to `most` bytes of data.
  bool accept(uint8_t type, uint8_t least, uint8_t most) {
    if (custom_count_ == MaxCustom || !is_custom_type(type) || find_custom(type) != kNone) return false;
    custom_[custom_count_++] = {type, least, most};
    return true;
  }

  // Takes settings, as if they were custom messages.
  bool accept_settings() {
    if (custom_count_ == MaxCustom) return false;
    custom_[custom_count_++] = {static_cast<uint8_t>(MessageType::Setting), 1, 5};
    return true;
  }

  // Has to be called for each byte. Returns true when it completed a valid packet, which packet() then holds.
  bool feed(uint8_t byte, uint32_t now_ms) {
    last_byte_ms_ = now_ms;
    if (byte != 0) {
      if (size_ == sizeof buffer_) {
        overflow_ = true;
      } else {
        buffer_[size_++] = byte;
      }
      return false;
    }
    const bool complete = size_ > 0 && finish();
    size_ = 0;
    overflow_ = false;
    return complete;
  }

  // Has to be called often, but only while no byte waits: what a delayed program finds there followed without a pause.
  // Gives up a packet whose end has not come within the frame timeout of its last byte.
  void poll(uint32_t now_ms) {
    if (size_ > 0 && now_ms - last_byte_ms_ >= frame_timeout_ms_) {
      ++counters.timeouts;
      size_ = 0;
      overflow_ = false;
    }
  }

  const Packet& packet() const { return packet_; }

  // When feed() has just counted a wrong length: the custom message, and how many bytes of data it should have had at
  // most. Null: it was a built-in one.
  const Packet* wrong_packet(uint8_t* most) const {
    if (packet_.custom == kNone) return 0;
    *most = custom_[packet_.custom].most;
    return &packet_;
  }

  Counters counters;

 private:
  bool finish() {
    size_t length = 0;
    if (overflow_) {
      ++counters.too_long;
      return false;
    }
    if (!cobs_decode(buffer_, size_, buffer_, &length)) {
      ++counters.cobs_errors;
      return false;
    }
    if (length > MaxPacket) {
      ++counters.too_long;
      return false;
    }
    if (length == 0) return false;
    packet_.type = static_cast<MessageType>(buffer_[0]);
    packet_.data = buffer_ + 1;
    packet_.size = length - 1;
    packet_.custom = find_custom(buffer_[0]);
    const Custom* custom = packet_.custom == kNone ? 0 : custom_ + packet_.custom;
    if (buffer_[0] >= kMessageTypes && !custom) {
      ++counters.unknown_type;
      return false;
    }
    if (custom ? packet_.size < custom->least || packet_.size > custom->most
               : !length_fits(packet_.type, packet_.size)) {
      ++counters.wrong_length;
      return false;
    }
    return true;
  }

  static bool length_fits(MessageType type, size_t size) {
    switch (type) {
      case MessageType::SpeedCmd:
      case MessageType::SteeringCmd:
      case MessageType::SteeringAngle:
        return size == 2;
      case MessageType::LedCmd:
        return size <= kLedTextMax + 1;
      case MessageType::Ticks:
        return size == 1;
      case MessageType::Imu:
        return size == kImuDataSize;
      case MessageType::Voltage:
        return size == 4;
      case MessageType::Heartbeat:
      case MessageType::ImuCalibration:
        return size == 0;
      default:
        return true;  // log text of any length
    }
  }

  static const uint8_t kNone = 255;
  struct Custom {
    uint8_t type;
    uint8_t least;  // bytes of data
    uint8_t most;
  };

  uint8_t find_custom(uint8_t type) const {
    for (uint8_t i = 0; i < custom_count_; ++i) {
      if (custom_[i].type == type) return i;
    }
    return kNone;
  }

  Custom custom_[MaxCustom];
  uint8_t custom_count_ = 0;
  uint8_t buffer_[cobs_encoded_max(MaxPacket)];
  size_t size_ = 0;
  bool overflow_ = false;
  uint32_t frame_timeout_ms_;
  uint32_t last_byte_ms_ = 0;
  Packet packet_ = {MessageType::Debug, 0, 0, kNone};
};

}  // namespace serial_communication

#endif
