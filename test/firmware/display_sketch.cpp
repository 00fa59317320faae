// A sketch that takes texts of any length.
#include <Arduino.h>
#include <PacketLink.h>
#include "display.h"

PacketLink bridge(Serial);

void handle_display(const Display<16>& display) {
  uint8_t size = 0;
  while (size < sizeof display.data && display.data[size] != 0) ++size;
  bridge.send(60, display.data, size);
}

void setup() { bridge.on<Display<16>>(Display<16>::TYPE, handle_display); }

void loop() { bridge.update(); }

#if defined(ON_THE_PC)
#include "stdio_board.h"
#endif
