// A model car on an AVR: the built-in commands and measurements, and a motor that stops when the bridge
// ends. No rows are needed. On the computer: ~speed, ~steering, ~led, ~ticks, ~voltage, ~steering_angle.
//
// firmware/nano_car is a whole car. Use bridge.log("text"), not Serial.print, which breaks the packet that follows.

#include <PacketLink.h>
#include <util/atomic.h>

const uint8_t kEncoderPin = 2;   // rising edges
const uint8_t kMotorPin = 3;     // PWM of an H-bridge; 10 kOhm to ground on all three of its pins
const uint8_t kForwardPin = 7;   // its inputs
const uint8_t kBackwardPin = 8;
const uint8_t kBrakeLampPin = 12;
const uint8_t kFeedbackPin = A0;  // of the steering servo
const uint8_t kBatteryPin = A1;   // through a divider: 20 V at full scale

PacketLink bridge(Serial);
HeartbeatWatch heartbeats;  // 30 ms; HeartbeatWatch(51) waits 50 ms
volatile uint8_t encoder_ticks = 0;

void motor(int16_t speed) {
  digitalWrite(kForwardPin, speed > 0);
  digitalWrite(kBackwardPin, speed < 0);
  analogWrite(kMotorPin, abs(speed) * 51L / 200);  // 0 … 1000 to 0 … 255
}

// Every 1.024 ms, even if loop() is delayed: without heartbeats the motor stops.
ISR(TIMER0_COMPA_vect) {
  heartbeats.tick(Serial.available());
  if (!heartbeats.alive()) motor(0);
}

void handle_speed(int16_t speed) {
  static bool backward = false;
  if (backward != (speed < 0)) {
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { motor(0); }
    delay(3);  // both inputs low for a period of the PWM, before it changes direction
  }
  backward = speed < 0;
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    if (heartbeats.alive()) motor(speed);
  }
}

void handle_steering(uint16_t pulse_us) {
  OCR1A = constrain(pulse_us, 1000, 2000) * 2;  // the servo is on pin 9
}

void handle_led(const char* text) {
  digitalWrite(kBrakeLampPin, strcmp(text, "brake") == 0);
}

void handle_calibration() {
  bridge.warn(F("this car has no IMU"));  // one that has sends bridge.send_imu(data), an ImuData
}

void count_tick() {
  if (encoder_ticks < 255) ++encoder_ticks;
}

void setup() {
  const uint8_t outputs[] = {kMotorPin, kForwardPin, kBackwardPin, kBrakeLampPin, 9};
  for (uint8_t pin : outputs) pinMode(pin, OUTPUT);
  pinMode(kEncoderPin, INPUT_PULLUP);
  attachInterrupt(digitalPinToInterrupt(kEncoderPin), count_tick, RISING);
  TCCR1A = _BV(COM1A1) | _BV(WGM11);  // Timer1: a pulse every 20 ms
  TCCR1B = _BV(WGM13) | _BV(WGM12) | _BV(CS11);
  ICR1 = 39999;
  handle_steering(1500);

  Serial.begin(115200);
  bridge.on_speed(handle_speed);
  bridge.on_steering(handle_steering);
  bridge.on_led(handle_led);
  bridge.on_calibration(handle_calibration);
  bridge.watch(heartbeats);
  TIMSK0 |= _BV(OCIE0A);  // Timer0 counts millis(); this is its other interrupt
  bridge.info(F("car ready"));
}

void loop() {
  static uint32_t beat_ms = 0;
  static uint8_t beats = 0;
  bridge.update();
  if (millis() - beat_ms < 10) return;
  beat_ms += 10;
  uint8_t ticks;
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    ticks = encoder_ticks;
    encoder_ticks = 0;
  }
  bridge.send_ticks(ticks);
  bridge.send_steering_angle(analogRead(kFeedbackPin));
  if (++beats == 100) {
    beats = 0;
    const float volts = analogRead(kBatteryPin) * 20.0f / 1024;
    bridge.send_voltage(volts);
    if (volts < 6.5f) bridge.error(F("battery empty"));
  }
}
