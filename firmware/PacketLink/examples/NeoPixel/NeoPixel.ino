// Up to six NeoPixels (WS2812) at pin 6 have the colour ~lights. It needs the library Adafruit NeoPixel. Any AVR or
// ESP32. See firmware/README.md.
//
// On an AVR a pixel takes 30 us, with interrupts disabled: more than six would lose bytes of the bridge.

#include <Adafruit_NeoPixel.h>
#include <PacketLink.h>

const uint8_t kPin = 6;
const uint8_t kPixels = 6;

const char kRows[] PROGMEM =
    "firmware: lights 1.0\n"
    "lights: {type: 33, direction: to_board, ros_type: std_msgs/ColorRGBA, layout: '<3B', fields: [r, g, b],"
    " scale: 0.00392156862745098, minimum: 0, maximum: 1}\n";

struct PACKED Lights {
  uint8_t red, green, blue;
};

PacketLink bridge(Serial);
Adafruit_NeoPixel pixels(kPixels, kPin, NEO_GRB + NEO_KHZ800);

void handle_lights(const Lights& lights) {
  pixels.fill(pixels.Color(lights.red, lights.green, lights.blue));
  pixels.show();
}

void setup() {
  pixels.begin();
  pixels.show();
  Serial.begin(115200);
  bridge.on<Lights>(33, handle_lights);
  bridge.announce(kRows);
}

void loop() {
  bridge.update();
}
