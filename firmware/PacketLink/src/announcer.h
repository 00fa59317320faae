// Announces the custom messages of a board to the bridge, which then needs no rows for them. The text has one row
// a line, after a first line `firmware: NAME VERSION` where that is wanted:
//
//   const char kRows[] PROGMEM =
//       "firmware: hello 1.0\n"
//       "light: {type: 32, ros_type: std_msgs/UInt16, layout: '<H', fields: [data]}\n";
//   bridge.announce(kRows);      // in setup(), for a PacketLink, a FrameLink or a BusSlave
//
// It stays in program memory, and is sent in chunks:
//
//   | index | count | CRC-16 of the whole text | text … |

#ifndef SERIAL_COMMUNICATION_ANNOUNCER_H
#define SERIAL_COMMUNICATION_ANNOUNCER_H

#include <Arduino.h>

#include "stream_sink.h"

namespace serial_communication {

// `Text`: bytes of text in a chunk. `Framing`: what a packet or frame has besides the chunk.
template <uint8_t Text, uint8_t Framing = 0>
class Announcer {
 public:
  static const uint8_t kHead = 4;
  static const uint8_t kMaxChunk = kHead + Text;

  template <size_t Size>
  void begin(const char (&text)[Size]) {
    static_assert(Size - 1 <= 2048, "an announcement has at most 2048 bytes");
    text_ = text;
    size_ = Size - 1;
    crc_ = 0xFFFF;
    for (uint16_t at = 0; at < size_; ++at) {  // CRC-16/CCITT-FALSE
      uint8_t x = static_cast<uint8_t>(crc_ >> 8) ^ byte_at(at);
      x ^= x >> 4;
      crc_ = static_cast<uint16_t>(crc_ << 8 ^ static_cast<uint16_t>(x) << 12 ^ static_cast<uint16_t>(x) << 5 ^ x);
    }
    const uint8_t count = (size_ + Text - 1) / Text;
    quick_ = count > 15 ? 2 * count : 30;
    hurry();
  }

  // Writes a chunk to `chunk`, which has room for kMaxChunk bytes. Returns its size; 0: there is no such chunk.
  uint8_t get(uint8_t index, uint8_t* chunk) const {
    const uint16_t start = static_cast<uint16_t>(index) * Text;
    if (start >= size_) return 0;
    const uint16_t rest = size_ - start;
    const uint8_t size = rest < Text ? rest : Text;
    chunk[0] = index;
    chunk[1] = static_cast<uint8_t>((size_ + Text - 1) / Text);
    chunk[2] = static_cast<uint8_t>(crc_);
    chunk[3] = static_cast<uint8_t>(crc_ >> 8);
    for (uint8_t i = 0; i < size; ++i) chunk[kHead + i] = byte_at(start + i);
    return kHead + size;
  }

  static uint8_t get_from(const Announcer& announcer, uint8_t index, uint8_t* chunk) {
    return announcer.get(index, chunk);
  }

  // Whether a chunk is to be sent now. There is one every 100 ms until each has gone twice and for at least 3 s, later
  // one a second. It is sent only while the send buffer is empty, so that nothing else has to wait for it. (Where that
  // is never empty, the chunk leaves as soon as it has room, a second late.)
  bool is_due(SendBuffer& buffer, uint32_t now_ms) {
    const uint16_t waited = static_cast<uint16_t>(now_ms) - sent_ms_;
    const uint16_t period = often_ > 0 ? 100 : 1000;
    if (waited < period) return false;
    if (!buffer.is_empty() && (waited < period + 1000 || !buffer.has_room(kMaxChunk + Framing))) return false;
    sent_ms_ = static_cast<uint16_t>(now_ms);
    if (often_ > 0) --often_;
    return true;
  }

  // Likewise that chunk; 0: nothing is announced.
  uint8_t next(uint8_t* chunk) {
    const uint8_t size = get(index_, chunk);
    if (size > 0 && ++index_ == chunk[1]) index_ = 0;
    return size;
  }

  // Somebody may listen anew: the next chunks are sent more often.
  void hurry() { often_ = quick_; }

 private:
  uint8_t byte_at(uint16_t at) const { return pgm_read_byte(text_ + at); }

  const char* text_ = 0;  // in program memory
  uint16_t size_ = 0;     // 0: nothing is announced
  uint16_t crc_ = 0;
  uint16_t sent_ms_ = 0;  // when the latest chunk was sent
  uint16_t quick_ = 0;    // chunks until each has gone twice, at least 30
  uint16_t often_ = 0;    // so many more chunks every 100 ms
  uint8_t index_ = 0;     // of the next chunk
};

}  // namespace serial_communication

#endif
