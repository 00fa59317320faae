// Controls the speed of a wheel by PID. The three gains are settings, which change while it runs: with rqt_reconfigure,
// dynparam or the page of the bridge. On the computer: ~target and ~wheel_speed, in turns a second. For an ATmega328P.
//
// The port belongs to the bridge: do not Serial.print to it.

#include <PacketLink.h>
#include <safe_board.h>
#include <util/atomic.h>

//      number, variable, type, value at the start, minimum, maximum, unit, description
#define SETTINGS(SETTING)                                               \
  SETTING(1, kp, float, 4, 0, 200, "PWM/(turn/s)", "proportional gain") \
  SETTING(2, ki, float, 20, 0, 1000, "PWM/turn", "integral gain")       \
  SETTING(3, kd, float, 0, 0, 20, "PWM/(turn/s^2)", "derivative gain")

SETTINGS(SETTING_VARIABLE)
constexpr Setting kSettings[] PROGMEM = {SETTINGS(SETTING_ENTRY)};
const char kRows[] PROGMEM =
    "firmware: tuning 1.0\n"
    "target: {type: 32, direction: to_board, ros_type: std_msgs/Float32, layout: '<f', fields: [data],"
    " minimum: 0, maximum: 15}\n"
    "wheel_speed: {type: 33, ros_type: std_msgs/Float32, layout: '<f', fields: [data]}\n"
    SETTINGS(SETTING_ROW);

struct PACKED Target {
  float turns;  // a second
};
struct PACKED Speed {
  float turns;  // a second
};

const float kTicksPerTurn = 64;
const uint8_t kPeriodMs = 10;
const uint8_t kEncoderPin = 2;  // rising edges
const uint8_t kMotorPin = 3;    // PWM of an H-bridge
const uint8_t kForwardPin = 7;  // its input
const uint8_t kOutputs[] = {kMotorPin, kForwardPin};  // 10 kOhm to ground on each: see safe_board.h

PacketLink bridge(Serial);
float target = 0;
float integral = 0;
volatile bool stopped = true;  // for want of heartbeats; it then waits for another target
volatile uint16_t ticks = 0;
volatile uint32_t tick_us = 0;

void motor(uint8_t pwm) {
  digitalWrite(kForwardPin, pwm > 0);
  analogWrite(kMotorPin, pwm);
}

void motor_off() {
  motor(0);
  stopped = true;
}

STOP_WITHOUT_HEARTBEATS(motor_off)

void handle_target(const Target& command) {
  if (command.turns >= 0 && command.turns <= 15) target = command.turns;
}

void count_tick() {
  ++ticks;
  tick_us = micros();
}

// Turns a second, from the time between the last tick and that of the call before.
float measure() {
  static uint32_t last_us = 0;
  static float speed = 0;
  uint16_t count;
  uint32_t us;
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    count = ticks;
    ticks = 0;
    us = tick_us;
  }
  if (count > 0) {
    speed = count * 1e6f / kTicksPerTurn / (us - last_us);
    last_us = us;
  } else if (micros() - last_us > 100000) {
    speed = 0;
  }
  return speed;
}

float in_range_of_pwm(float value) {
  return value < 0 ? 0 : value > 255 ? 255 : value;
}

void control(float speed) {
  static float last_speed = 0;
  const float seconds = kPeriodMs * 0.001f;
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    if (stopped) target = 0;
    stopped = false;
  }
  const float error = target - speed;
  integral = target > 0 ? in_range_of_pwm(integral + ki * error * seconds) : 0;
  const float pwm = kp * error + integral - kd * (speed - last_speed) / seconds;
  const uint8_t wanted = target > 0 ? in_range_of_pwm(pwm) : 0;
  last_speed = speed;
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    if (heartbeats.alive()) motor(wanted);
  }
}

void setup() {
  safe_begin(kOutputs, bridge, heartbeats);
  pinMode(kEncoderPin, INPUT_PULLUP);
  attachInterrupt(digitalPinToInterrupt(kEncoderPin), count_tick, RISING);
  Serial.begin(115200);
  bridge.on<Target>(32, handle_target);
  bridge.announce(kRows);
  bridge.settings(kSettings);
}

void loop() {
  static uint32_t control_ms = 0;
  bridge.update();
  if (millis() - control_ms < kPeriodMs) return;
  control_ms += kPeriodMs;
  safe_update();
  Speed speed;
  speed.turns = measure();
  control(speed.turns);
  bridge.send(33, speed);
}
