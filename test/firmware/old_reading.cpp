// Polls an SHT3x for 49.7 days after it was lost, which may not make its last reading valid again: prints 10.
#include <cstdio>
#include <cstring>
#include "sht3x.cpp"
static bool present = true;
bool serial_communication::i2c_transfer(uint8_t, const uint8_t*, uint8_t, uint8_t* in,
                                        uint8_t size) {
  if (size > 0) memcpy(in, "\0\0\x81\0\0\x81", 6);
  return present;
}
int main() {
  Sht3x sensor;
  uint32_t now = 5000;
  for (; now < 6000; ++now) sensor.poll(now);
  std::printf("%d", sensor.valid());
  present = false;
  for (uint32_t ms = 0; ms < 5000; ++ms) sensor.poll(++now);
  std::printf("%d", sensor.valid());
  for (uint32_t polls = 0; polls < 4300000; ++polls) {
    sensor.poll(now += 1000);
    if (sensor.valid()) std::printf(" valid after 49.7 days");
  }
}
