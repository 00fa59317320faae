// A sketch of one's own, which test_own_sketch.py builds and runs.
// Functions are used before they are defined, also across files, as the IDE allows it.
#include <PacketLink.h>
#include <Wire.h>
#include "part.h"

struct PACKED Light { uint16_t raw; };
PacketLink bridge(Serial);

void setup() {
  Serial.begin(115200);
  Wire.begin();
  pinMode(5, OUTPUT);
  pinMode(6, INPUT_PULLUP);
  bridge.log("started");
}

void loop() {
  bridge.update();
  copy_pins();
  if (every(20)) report(twice(analogRead(A0)));
}

void report(uint16_t raw)
{
  Light light = {raw};
  bridge.send(32, light);
}
