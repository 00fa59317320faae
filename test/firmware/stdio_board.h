// A board on the PC for one sketch: its serial port is stdin and stdout, and 200 s pass after the last byte.

#include <cstdio>
HardwareSerial Serial;
static unsigned long now_ms = 0;
unsigned long millis() { return now_ms; }
int HardwareSerial::available() { return ungetc(getchar(), stdin) != EOF; }
int HardwareSerial::read() { return getchar(); }
size_t HardwareSerial::write(uint8_t byte) { return write(&byte, 1); }
size_t HardwareSerial::write(const uint8_t* bytes, size_t size) {
  return fwrite(bytes, 1, size, stdout);
}
int main() {
  setup();
  while (Serial.available()) loop();
  for (; now_ms < 200000; ++now_ms) loop();
}
