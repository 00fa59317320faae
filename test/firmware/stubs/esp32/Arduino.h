// The signatures of the ESP32's Arduino core that the library and the sensor board use. There is nothing behind
// them but what a test defines.

#ifndef STUB_ARDUINO_H
#define STUB_ARDUINO_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#define HIGH 1
#define LOW 0
#define INPUT 1
#define OUTPUT 3
#define INPUT_PULLUP 5
#define OUTPUT_OPEN_DRAIN 0x13
typedef bool boolean;
const uint8_t A0 = 36;
const uint8_t A3 = 39;

unsigned long millis();
unsigned long micros();
void delay(uint32_t ms);
void delayMicroseconds(uint32_t us);
int digitalRead(uint8_t pin);
void enableLoopWDT();
void feedLoopWDT();
void pinMode(uint8_t pin, uint8_t mode);
void digitalWrite(uint8_t pin, uint8_t level);
uint16_t analogRead(uint8_t pin);

class __FlashStringHelper;
#define F(text) (reinterpret_cast<const __FlashStringHelper*>(text))
#define PROGMEM
#define memcpy_P memcpy
#define pgm_read_byte(address) (*reinterpret_cast<const unsigned char*>(address))

class Stream {
 public:
  virtual int available() = 0;
  virtual int read() = 0;
  virtual int availableForWrite() { return 0; }
  virtual size_t write(uint8_t byte) = 0;
  virtual size_t write(const uint8_t* buffer, size_t size) = 0;
};

class HardwareSerial : public Stream {
 public:
  void begin(unsigned long baud, uint32_t config = 0, int8_t rx_pin = -1, int8_t tx_pin = -1, bool invert = false,
             unsigned long timeout_ms = 20000UL, uint8_t rxfifo_full_threshold = 112);
  int available() override;
  int read() override;
  size_t write(uint8_t byte) override;
  size_t write(const uint8_t* buffer, size_t size) override;
};
extern HardwareSerial Serial;

#endif
