// An ultrasonic sensor HC-SR04, trigger at pin 7, echo at pin 2: ~sonar, 20 times a second; NaN without an echo. An
// interrupt measures the echo, so loop() never waits. Any AVR. See firmware/README.md.

#include <PacketLink.h>

const uint8_t kTriggerPin = 7;
const uint8_t kEchoPin = 2;        // has an interrupt
const uint32_t kPeriodMs = 50;     // an echo takes at most 38 ms
const uint16_t kNoEcho = 65535;

const char kRows[] PROGMEM =
    "firmware: sonar 1.0\n"
    "sonar: {type: 32, ros_type: sensor_msgs/Range, layout: '<H', fields: [range], scale: 0.001, invalid: 65535,"
    " maximum: 4, frame_id: sonar,"
    " constants: {radiation_type: 0, field_of_view: 0.26, min_range: 0.02, max_range: 4}}\n";

PacketLink bridge(Serial);
volatile uint32_t began_us = 0;
volatile uint16_t echo_us = 0;  // 0: none yet

void on_echo() {
  if (digitalRead(kEchoPin)) {
    began_us = micros();
  } else if (micros() - began_us < 30000) {
    echo_us = micros() - began_us;
  }
}

void setup() {
  pinMode(kTriggerPin, OUTPUT);
  pinMode(kEchoPin, INPUT);
  attachInterrupt(digitalPinToInterrupt(kEchoPin), on_echo, CHANGE);
  Serial.begin(115200);
  bridge.announce(kRows);
}

void loop() {
  static uint32_t pulse_ms = 0;
  bridge.update();
  if (millis() - pulse_ms < kPeriodMs) return;
  pulse_ms += kPeriodMs;
  noInterrupts();
  const uint16_t us = echo_us;
  echo_us = 0;
  interrupts();
  const uint32_t mm = us * 343UL / 2000;  // sound: 343 m/s, there and back
  bridge.send(32, us == 0 || mm > 4000 ? kNoEcho : static_cast<uint16_t>(mm));
  bridge.time(micros());                  // of the pulse that follows: its echo is sent next
  digitalWrite(kTriggerPin, HIGH);
  delayMicroseconds(10);
  digitalWrite(kTriggerPin, LOW);
}
