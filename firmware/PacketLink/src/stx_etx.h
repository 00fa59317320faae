// The sender of the status frames of the sensor boards (two VL53L0X and a BNO055, or six ADC channels), and the
// receiver of settings, the only frames to a board.
//
//   | 0x02 STX | LEN | TYPE | SEQ | PAYLOAD … | CRC | 0x03 ETX |
//
// LEN counts TYPE, SEQ and PAYLOAD; CRC is the XOR of the same bytes; SEQ counts up by one a frame.
// Little-endian.
//
// FrameLink.h uses this; a sketch includes that one. Bytes are sent through a sink, any callable
// (const uint8_t* bytes, size_t size) that returns whether it accepted them all: one call a frame.

#ifndef SERIAL_COMMUNICATION_STX_ETX_H
#define SERIAL_COMMUNICATION_STX_ETX_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#include "packed.h"

namespace serial_communication {

const uint8_t kStx = 0x02;
const uint8_t kEtx = 0x03;
const uint8_t kTypeAdcStatus = 0x01;
const uint8_t kTypeSensorStatus = 0x10;
const uint16_t kRangeTimedOut = 0xFFFF;
const uint8_t kTypeSetting = 0xFD;
const uint8_t kTypeTime = 0xFE;
const uint8_t kTypeAnnouncement = 0xFF;
const int16_t kAngleUnknown = -32768;

inline uint8_t stx_etx_crc(const uint8_t* bytes, size_t size) {
  uint8_t crc = 0;
  for (size_t i = 0; i < size; ++i) crc ^= bytes[i];
  return crc;
}

struct SensorStatus {
  uint16_t range_mm[2];  // kRangeTimedOut: no reading
  int32_t yaw;           // 0.01 degree, clockwise, 0 … 35999; wraps in the frame's int16
  int16_t pitch;         // 0.01 degree; kAngleUnknown in both: no attitude, and yaw means nothing
  int16_t roll;          // 0.01 degree
};

template <class Sink>
class StxEtxSender {
 public:
  static const size_t kMaxPayload = 32;

  explicit StxEtxSender(Sink sink) : sink_(sink) {}

  // A custom message: any packed struct. False: the type (any but 0x01, 0x10 and 0xFD … 0xFF) is not that of a custom message,
  // or not all of the frame was sent.
  template <class T>
  bool send(uint8_t type, const T& value) {
    check_can_cross_the_wire<T>();
    static_assert(sizeof(T) <= kMaxPayload, "a frame of this sender holds no more");
    return send(type, &value, sizeof value);
  }

  // Likewise with a payload of any length. False also where it is too long.
  bool send(uint8_t type, const void* payload, size_t size) {
    if (type == kTypeAdcStatus || type == kTypeSensorStatus || type >= kTypeSetting) return false;
    return send_frame(type, payload, size);
  }

  // Tells when the next frame was measured: its topics have the stamp of that moment. Does nothing with NO_BOARD_TIME.
  //
  // Args: microseconds, by micros(), read when it is measured.
  bool time(uint32_t microseconds) {
#ifdef NO_BOARD_TIME
    (void)microseconds;
    return true;
#else
    const uint8_t payload[4] = {static_cast<uint8_t>(microseconds), static_cast<uint8_t>(microseconds >> 8),
                                static_cast<uint8_t>(microseconds >> 16), static_cast<uint8_t>(microseconds >> 24)};
    return send_frame(kTypeTime, payload, sizeof payload);
#endif
  }

  bool send_sensor_status(const SensorStatus& status) {
    const uint16_t fields[5] = {status.range_mm[0], status.range_mm[1], static_cast<uint16_t>(status.yaw),
                                static_cast<uint16_t>(status.pitch), static_cast<uint16_t>(status.roll)};
    return send_uint16(kTypeSensorStatus, fields, 5);
  }

  bool send_adc_status(const uint16_t channels[6]) { return send_uint16(kTypeAdcStatus, channels, 6); }

 protected:
  bool send_frame(uint8_t type, const void* payload, size_t size) {
    if (size > kMaxPayload) return false;
    uint8_t frame[kMaxPayload + 6];
    frame[0] = kStx;
    frame[1] = static_cast<uint8_t>(2 + size);
    frame[2] = type;
    frame[3] = sequence_++;
    if (size > 0) memcpy(frame + 4, payload, size);
    frame[4 + size] = stx_etx_crc(frame + 2, 2 + size);
    frame[5 + size] = kEtx;
    return sink_(static_cast<const uint8_t*>(frame), size + 6);
  }

 private:
  bool send_uint16(uint8_t type, const uint16_t* fields, uint8_t count) {
    uint8_t payload[12];
    for (uint8_t i = 0; i < count; ++i) {
      payload[2 * i] = static_cast<uint8_t>(fields[i]);
      payload[2 * i + 1] = static_cast<uint8_t>(fields[i] >> 8);
    }
    return send_frame(type, payload, 2 * count);
  }

  Sink sink_;
  uint8_t sequence_ = 0;
};

// Finds the frames that carry a setting; drops all else. A frame that begins inside what looked like one is found.
class SettingReceiver {
 public:
  // Comes before all else. (Initial values would be code in every sketch.)
  void begin() {
    size_ = 0;
    whole_ = false;
  }

  // Returns the payload, valid until the next call, when this byte completed a frame; else null.
  const uint8_t* feed(uint8_t byte, uint8_t* size) {
    if (whole_) drop(static_cast<uint8_t>(frame_[1] + 4));
    whole_ = false;
    frame_[size_++] = byte;
    while (size_ > 0 && !may_be_one()) drop(1);
    if (!whole_) return 0;
    *size = static_cast<uint8_t>(frame_[1] - 2);
    return frame_ + 4;
  }

 private:
  static const uint8_t kLeast = 2 + 1, kMost = 2 + 5;  // LEN: of the number alone, and with a value

  // Whether the bytes are a frame, or the beginning of one.
  bool may_be_one() {
    if (frame_[0] != kStx) return false;
    if (size_ > 1 && (frame_[1] < kLeast || frame_[1] > kMost)) return false;
    if (size_ > 2 && frame_[2] != kTypeSetting) return false;
    if (size_ < 2 || size_ < frame_[1] + 4) return true;
    whole_ = frame_[3 + frame_[1]] == kEtx && frame_[2 + frame_[1]] == stx_etx_crc(frame_ + 2, frame_[1]);
    return whole_;
  }

  void drop(uint8_t count) {
    size_ = static_cast<uint8_t>(size_ - count);
    memmove(frame_, frame_ + count, size_);
  }

  uint8_t frame_[kMost + 4];
  uint8_t size_;
  bool whole_;
};

}  // namespace serial_communication

#endif
