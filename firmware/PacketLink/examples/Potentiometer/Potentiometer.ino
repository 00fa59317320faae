// A potentiometer at A0: ~knob is from 0 to 1, 50 times a second. Any AVR; an ESP32 with kReadings = 4, since its
// converter has two bits more. See firmware/README.md.

#include <PacketLink.h>

const uint8_t kReadings = 16;  // their sum has a range of 0 … 16368

const char kRows[] PROGMEM =
    "firmware: potentiometer 1.0\n"
    "knob: {type: 32, ros_type: std_msgs/Float32, layout: '<H', fields: [data], scale: 0.0000610948}\n";

PacketLink bridge(Serial);

void setup() {
  Serial.begin(115200);
  bridge.announce(kRows);
}

void loop() {
  static uint32_t sent_ms = 0;
  bridge.update();
  if (millis() - sent_ms < 20) return;
  sent_ms += 20;
  uint16_t sum = 0;
  for (uint8_t i = 0; i < kReadings; ++i) sum += analogRead(A0);
  bridge.send(32, sum);
}
