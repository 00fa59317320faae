// The signatures of the ESP32's Wire library that the sensor board uses.

#ifndef STUB_WIRE_H
#define STUB_WIRE_H

#include "Arduino.h"

class TwoWire {
 public:
  bool begin(int sda = -1, int scl = -1, uint32_t frequency = 0);
  bool setClock(uint32_t frequency);
  void setTimeOut(uint16_t timeout_ms);
  void beginTransmission(uint8_t address);
  uint8_t endTransmission(bool send_stop = true);
  uint8_t requestFrom(uint16_t address, uint8_t size, bool send_stop);
  uint8_t requestFrom(uint8_t address, uint8_t size);
  size_t write(uint8_t byte);
  size_t write(const uint8_t* bytes, size_t size);
  int read();
};
extern TwoWire Wire;

#endif
