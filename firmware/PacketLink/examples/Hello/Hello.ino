// Sends one value and takes one command, and announces both: `rostopic list` has light and lamp. Any AVR or ESP32.
// Use bridge.log("text"), not Serial.print, which breaks the packet that follows.

#include <PacketLink.h>

#ifndef LED_BUILTIN  // most ESP32 boards have a LED at pin 2, without this name
#define LED_BUILTIN 2
#endif

const char kRows[] PROGMEM =
    "firmware: hello 1.0\n"
    "light: {type: 32, ros_type: std_msgs/UInt16, layout: '<H', fields: [data]}\n"
    "lamp: {type: 33, direction: to_board, ros_type: std_msgs/Bool, layout: '<?', fields: [data]}\n";

struct PACKED Light {
  uint16_t raw;
};
struct PACKED Lamp {
  uint8_t on;
};

PacketLink bridge(Serial);

void handle_lamp(const Lamp& lamp) {
  digitalWrite(LED_BUILTIN, lamp.on ? HIGH : LOW);
}

void setup() {
  pinMode(LED_BUILTIN, OUTPUT);
  Serial.begin(115200);
  bridge.on<Lamp>(33, handle_lamp);
  bridge.announce(kRows);
}

void loop() {
  static uint32_t sent_ms = 0;
  bridge.update();
  if (millis() - sent_ms >= 100) {
    sent_ms += 100;
    bridge.time(micros());  // when it is measured
    Light light = {uint16_t(analogRead(A0))};
    bridge.send(32, light);
  }
}
