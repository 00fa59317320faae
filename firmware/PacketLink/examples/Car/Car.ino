// A model car on an ATmega328P: the built-in commands and measurements, and a motor that stops when the bridge ends,
// the cable breaks, or the program hangs. No rows are needed. On the computer: ~speed, ~steering, ~led, ~ticks,
// ~voltage, ~steering_angle.
//
// firmware/nano_car is a whole car. Use bridge.log("text"), not Serial.print, which breaks the packet that follows.

#include <PacketLink.h>
#include <rate_limit.h>
#include <safe_board.h>
#include <util/atomic.h>

const uint8_t kEncoderPin = 2;   // rising edges
const uint8_t kMotorPin = 3;     // PWM of an H-bridge
const uint8_t kForwardPin = 7;   // its inputs
const uint8_t kBackwardPin = 8;
const uint8_t kOutputs[] = {kMotorPin, kForwardPin, kBackwardPin};  // 10 kOhm to ground on each: see safe_board.h
const uint8_t kBrakeLampPin = 12;
const uint8_t kFeedbackPin = A0;  // of the steering servo
const uint8_t kBatteryPin = A1;   // through a divider: 20 V at full scale

PacketLink bridge(Serial);
volatile uint8_t encoder_ticks = 0;

void motor(int16_t speed) {
  digitalWrite(kForwardPin, speed > 0);
  digitalWrite(kBackwardPin, speed < 0);
  analogWrite(kMotorPin, abs(speed) * 51L / 200);  // 0 … 1000 to 0 … 255
}

void motor_off() {
  motor(0);
}

STOP_WITHOUT_HEARTBEATS(motor_off)

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

// A car that has an IMU calibrates it here, and sends bridge.send_imu(data), an ImuData.
void handle_calibration() {
  static RateLimit limit;  // one answer a second, however often it is called
  if (limit.passes(millis())) bridge.warn(F("this car has no IMU"));
}

void count_tick() {
  if (encoder_ticks < 255) ++encoder_ticks;
}

void setup() {
  safe_begin(kOutputs, bridge, heartbeats);
  pinMode(kBrakeLampPin, OUTPUT);
  pinMode(9, OUTPUT);
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
  bridge.info(F("car ready"));
}

void loop() {
  static uint32_t beat_ms = 0;
  static uint8_t beats = 0;
  bridge.update();
  if (millis() - beat_ms < 10) return;
  beat_ms += 10;
  safe_update();
  uint8_t ticks;
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    ticks = encoder_ticks;
    encoder_ticks = 0;
  }
  bridge.time(micros());  // when the packets below are measured
  bridge.send_ticks(ticks);
  bridge.send_steering_angle(analogRead(kFeedbackPin));
  if (++beats == 100) {
    beats = 0;
    const float volts = analogRead(kBatteryPin) * 20.0f / 1024;
    bridge.send_voltage(volts);
    if (volts < 6.5f) bridge.error(F("battery empty"));
  }
}
