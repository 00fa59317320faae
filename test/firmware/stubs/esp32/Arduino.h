// The signatures of the ESP32's Arduino core that the sensor board uses; there is nothing behind them.

#ifndef STUB_ARDUINO_H
#define STUB_ARDUINO_H

#include <stddef.h>
#include <stdint.h>

unsigned long millis();
void delay(uint32_t ms);

class HardwareSerial {
 public:
  void begin(unsigned long baud, uint32_t config = 0, int8_t rx_pin = -1, int8_t tx_pin = -1, bool invert = false,
             unsigned long timeout_ms = 20000UL, uint8_t rxfifo_full_threshold = 112);
  size_t write(uint8_t byte);
  size_t write(const uint8_t* buffer, size_t size);
};
extern HardwareSerial Serial;

#endif
