// Consistent Overhead Byte Stuffing: packets without a 0x00 inside, so that 0x00 can end them.
//
//   packet on the wire:  | code | code-1 bytes, none 0x00 | code | … | 0x00 |
//
// A code below 0xFF stands for its bytes and one 0x00 after them (none after the last block);
// 0xFF stands for 254 bytes with no 0x00 after them.

#ifndef SERIAL_COMMUNICATION_COBS_H
#define SERIAL_COMMUNICATION_COBS_H

#include <stddef.h>
#include <stdint.h>

namespace serial_communication {

// Room that `size` bytes need once encoded, the closing 0x00 not counted.
constexpr size_t cobs_encoded_max(size_t size) { return size + size / 254 + 1; }

// Encodes `size` bytes and returns the encoded length. Writes no closing 0x00.
inline size_t cobs_encode(const uint8_t* in, size_t size, uint8_t* out) {
  size_t code_at = 0;
  size_t length = 1;
  uint8_t code = 1;
  for (size_t i = 0; i < size; ++i) {
    if (in[i] != 0) {
      out[length++] = in[i];
      ++code;
    }
    // A full block is closed only when something follows: a packet may end with it.
    if (in[i] == 0 || (code == 0xFF && i + 1 < size)) {
      out[code_at] = code;
      code_at = length++;
      code = 1;
    }
  }
  out[code_at] = code;
  return length;
}

// Decodes one packet (without its closing 0x00); `out` may be `in`.
// Returns false for a 0x00 inside or a code that runs past the end.
inline bool cobs_decode(const uint8_t* in, size_t size, uint8_t* out, size_t* out_size) {
  size_t length = 0;
  size_t i = 0;
  while (i < size) {
    const uint8_t code = in[i++];
    if (code == 0 || i + code - 1 > size) return false;
    for (uint8_t k = 1; k < code; ++k) {
      if (in[i] == 0) return false;
      out[length++] = in[i++];
    }
    if (code != 0xFF && i < size) out[length++] = 0;
  }
  *out_size = length;
  return true;
}

}  // namespace serial_communication

#endif
