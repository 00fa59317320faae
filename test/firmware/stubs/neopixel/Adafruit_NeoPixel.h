// What the example NeoPixel uses of the library Adafruit NeoPixel, which Debian does not have: only declarations that
// compile, and nothing that lights up.

#ifndef ADAFRUIT_NEOPIXEL_H
#define ADAFRUIT_NEOPIXEL_H

#include <stdint.h>

typedef uint16_t neoPixelType;
const neoPixelType NEO_GRB = (1 << 6) | (1 << 4) | (0 << 2) | 2;
const neoPixelType NEO_KHZ800 = 0x0000;

class Adafruit_NeoPixel {
 public:
  Adafruit_NeoPixel(uint16_t, int16_t, neoPixelType) {}
  void begin() {}
  void show() {}
  void fill(uint32_t, uint16_t = 0, uint16_t = 0) {}
  static uint32_t Color(uint8_t, uint8_t, uint8_t) { return 0; }
};

#endif
