// A button from pin 2 to ground: ~button is true while it is pressed. Any AVR or ESP32. See firmware/README.md.

#include <PacketLink.h>

const uint8_t kPin = 2;
const uint32_t kBounceMs = 20;    // a level has to last so long
const uint32_t kRepeatMs = 1000;  // sent so often at least, for who subscribes later

const char kRows[] PROGMEM =
    "firmware: button 1.0\n"
    "button: {type: 32, ros_type: std_msgs/Bool, layout: '<?', fields: [data]}\n";

PacketLink bridge(Serial);

void setup() {
  pinMode(kPin, INPUT_PULLUP);
  Serial.begin(115200);
  bridge.announce(kRows);
}

void loop() {
  static bool pressed = false, level = false;
  static uint32_t changed_ms = 0, sent_ms = 0;
  bridge.update();
  const uint32_t now = millis();
  const bool read = digitalRead(kPin) == LOW;
  if (read != level) changed_ms = now;
  level = read;
  const bool changed = level != pressed && now - changed_ms >= kBounceMs;
  if (!changed && now - sent_ms < kRepeatMs) return;
  if (changed) pressed = level;
  sent_ms = now;
  bridge.send(32, static_cast<uint8_t>(pressed));
}
