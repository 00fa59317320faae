// A buzzer without electronics of its own, from pin 8 through 100 Ohm to ground: ~buzzer is its tone in Hz, for a second
// at most; 0 ends it. Any AVR. See firmware/README.md.

#include <PacketLink.h>

const uint8_t kPin = 8;

const char kRows[] PROGMEM =
    "firmware: buzzer 1.0\n"
    "buzzer: {type: 33, direction: to_board, ros_type: std_msgs/UInt16, layout: '<H', fields: [data],"
    " maximum: 10000}\n";

struct PACKED Buzzer {
  uint16_t hertz;
};

PacketLink bridge(Serial);

void handle_buzzer(const Buzzer& buzzer) {
  if (buzzer.hertz < 31 || buzzer.hertz > 10000) {  // tone() has none that is lower
    noTone(kPin);
  } else {
    tone(kPin, buzzer.hertz, 1000);
  }
}

void setup() {
  Serial.begin(115200);
  bridge.on<Buzzer>(33, handle_buzzer);
  bridge.announce(kRows);
}

void loop() {
  bridge.update();
}
