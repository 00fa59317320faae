// Hello on an ESP32. For the bridge this board is the `arduino`, not the `mcu`:
// sketch and link must have the same protocol, and that of the `mcu` only sends.
//
// The port belongs to the bridge: use bridge.log("text"), not Serial.print, which breaks the packet that follows.
// The bootloader of an ESP32 prints text, too; after a reset the bridge counts some errors, and says so.

#include <PacketLink.h>

const uint8_t kLampPin = 2;    // the blue LED of most boards
const uint8_t kLightPin = 34;  // an input of ADC1: ADC2 does not work while WiFi is on

const char kRows[] PROGMEM =
    "firmware: hello 1.0\n"
    "light: {type: 32, ros_type: std_msgs/UInt16, layout: '<H', fields: [data]}\n"
    "lamp: {type: 33, direction: to_board, ros_type: std_msgs/Bool, layout: '<?', fields: [data]}\n";

struct PACKED Light {
  uint16_t raw;  // 0 … 4095
};
struct PACKED Lamp {
  uint8_t on;
};

PacketLink bridge(Serial);

void handle_lamp(const Lamp& lamp) {
  digitalWrite(kLampPin, lamp.on ? HIGH : LOW);
}

void setup() {
  pinMode(kLampPin, OUTPUT);
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
    Light light;
    light.raw = analogRead(kLightPin);
    if (!bridge.send(32, light)) bridge.warn("light was not sent");  // false: not all of it was sent
  }
  delay(1);  // time for the tasks of the ESP32
}
