// A base with two driven wheels on an ATmega328P (Nano, Uno): takes cmd_vel, sends odom, and announces both, so the
// bridge needs no file. doc/wheels.md has the wiring, the first start, teleop, rviz and move_base.
//
// Each wheel has a motor on an H-bridge, an encoder with two channels, and a PID controller of its speed. Both motors
// are turned off 0.5 s after the last command, 30 ms after the last heartbeat, if the program hangs, and if a wheel
// does not turn as it is driven.

#include <PacketLink.h>
#include <safe_board.h>
#include <util/atomic.h>

// The base, and the controllers, whose output is the duty, -255 … 255. These change while it runs, too.
//      number, variable, type, value at the start, minimum, maximum, unit, description
#define SETTINGS(SETTING)                                                       \
  SETTING(1, wheel_radius, float, 0.0325, 0.005, 0.5, "m", "radius of a wheel") \
  SETTING(2, track, float, 0.16, 0.02, 2, "m", "distance of the wheels")        \
  SETTING(3, max_speed, float, 0.5, 0.01, 2, "m/s", "of a wheel")               \
  SETTING(4, forward, float, 300, 0, 5000, "duty/(m/s)", "of the wanted speed") \
  SETTING(5, kp, float, 300, 0, 5000, "duty/(m/s)", "of the error")             \
  SETTING(6, ki, float, 2500, 0, 50000, "duty/m", "of the sum of the errors")   \
  SETTING(7, kd, float, 0, 0, 500, "duty/(m/s^2)", "of the change of the speed")

SETTINGS(SETTING_VARIABLE)
constexpr Setting kSettings[] PROGMEM = {SETTINGS(SETTING_ENTRY)};
const float kEdgesPerTurn = 2 * 11 * 30;  // of one channel in a turn of the wheel: 11 pulses, gear 1:30

const uint32_t kPeriodUs = 20000;
const uint32_t kCommandMs = 500;   // a command counts so long
const uint8_t kBlockedPeriods = 25;  // with full duty, but without a turn in its direction

const char kRows[] PROGMEM =
    "firmware: diff_drive 1.0\n"
    "cmd_vel: {type: 41, direction: to_board, ros_type: geometry_msgs/Twist, layout: '<hh',"
    " fields: [linear.x, angular.z], scale: 0.001}\n"
    "odom: {type: 40, ros_type: nav_msgs/Odometry, layout: '<5f', fields: [pose.pose.position.x, pose.pose.position.y,"
    " pose.pose.orientation.yaw, twist.twist.linear.x, twist.twist.angular.z],"
    " minimum: [-10000, -10000, -7, -2, -30], maximum: [10000, 10000, 7, 2, 30],"
    " frame_id: odom, child_frame_id: base_link,"
    " constants: {pose.covariance: [0.01, 0.01, 1000000, 1000000, 1000000, 0.03],"
    " twist.covariance: [0.001, 0.001, 1000000, 1000000, 1000000, 0.01]}}\n"
    SETTINGS(SETTING_ROW);

struct PACKED CmdVel {
  int16_t ahead;  // mm/s
  int16_t turn;   // mrad/s, to the left
};
struct PACKED Odom {
  float x, y, yaw;    // m, rad
  float ahead, turn;  // m/s, rad/s
};

struct Wheel {
  uint8_t pwm_pin, forward_pin, backward_pin;
  volatile int16_t edges;  // since the last period; forward is positive
  int16_t duty;
  float wanted, speed;  // m/s
  float integral;       // of the duty
  uint8_t blocked;      // periods
};

// The encoders' channels A are on pins 2 and 3, which have interrupts, B on pins 4 and 5.
Wheel left = {9, 7, 8, 0, 0, 0, 0, 0, 0};
Wheel right = {10, 11, 12, 0, 0, 0, 0, 0, 0};
const uint8_t kOutputs[] = {9, 7, 8, 10, 11, 12};  // 10 kOhm to ground on each: see safe_board.h

PacketLink bridge(Serial);
volatile bool driving = false;
bool blocked = false;  // until the command is 0
uint32_t command_ms = 0;
Odom odom = {0, 0, 0, 0, 0};

// Called with interrupts disabled, as the next two.
void write_motor(const Wheel& wheel, int16_t duty) {
  digitalWrite(wheel.forward_pin, duty > 0);
  digitalWrite(wheel.backward_pin, duty < 0);
  analogWrite(wheel.pwm_pin, abs(duty));
}

// Before its direction changes, a bridge is off for a period.
void set_motor(Wheel& wheel, int16_t duty) {
  if ((duty > 0 && wheel.duty < 0) || (duty < 0 && wheel.duty > 0)) duty = 0;
  write_motor(wheel, duty);
  wheel.duty = duty;
}

void motors_off() {
  if (!driving) return;
  driving = false;
  write_motor(left, 0);  // the duties stay until the next period: it may drive again before
  write_motor(right, 0);
}

STOP_WITHOUT_HEARTBEATS(motors_off)

void stop() {
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { motors_off(); }
}

void handle_cmd_vel(const CmdVel& command) {
  const float ahead = command.ahead * 0.001f;
  const float turn = command.turn * 0.001f * track / 2;
  // If a wheel would be too fast, both are slower: the curve stays the same.
  const float fastest = fabsf(ahead) + fabsf(turn);
  const float share = fastest > max_speed ? max_speed / fastest : 1;
  left.wanted = (ahead - turn) * share;
  right.wanted = (ahead + turn) * share;
  command_ms = millis();
  if (fastest == 0) {
    stop();
    blocked = false;
    left.integral = right.integral = 0;
  } else if (!blocked) {
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { driving = heartbeats.alive(); }
  }
}

void count_left() {
  left.edges += bitRead(PIND, 2) != bitRead(PIND, 4) ? 1 : -1;
}

void count_right() {
  right.edges += bitRead(PIND, 3) != bitRead(PIND, 5) ? 1 : -1;
}

int16_t take_edges(Wheel& wheel) {
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    const int16_t edges = wheel.edges;
    wheel.edges = 0;
    return edges;
  }
  return 0;
}

void measure(float seconds) {
  const float edge = 2 * PI * wheel_radius / kEdgesPerTurn;
  const int16_t left_edges = take_edges(left);
  const int16_t right_edges = take_edges(right);
  left.speed = left_edges * edge / seconds;
  right.speed = right_edges * edge / seconds;

  const float ahead = (left_edges + right_edges) * edge / 2;
  const float turn = (right_edges - left_edges) * edge / track;
  odom.x += ahead * cosf(odom.yaw + turn / 2);
  odom.y += ahead * sinf(odom.yaw + turn / 2);
  odom.yaw += turn;
  if (fabsf(odom.yaw) > PI) odom.yaw -= odom.yaw > 0 ? 2 * PI : -2 * PI;
  odom.ahead = ahead / seconds;
  odom.turn = turn / seconds;
}

void control(Wheel& wheel, float last_speed, float seconds) {
  const float error = wheel.wanted - wheel.speed;
  const float duty = forward * wheel.wanted + kp * error + wheel.integral - kd * (wheel.speed - last_speed) / seconds;
  const bool full = fabsf(duty) >= 255;
  if (!full || duty * error < 0) wheel.integral += ki * error * seconds;
  wheel.blocked = full && duty * wheel.speed <= 0 ? wheel.blocked + 1 : 0;
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    if (driving && heartbeats.alive()) set_motor(wheel, constrain(duty, -255, 255));
  }
}

void drive(float last_left, float last_right, float seconds) {
  if (driving && millis() - command_ms > kCommandMs) stop();
  if (!driving) {
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { left.duty = right.duty = 0; }
    left.integral = right.integral = 0;
    left.blocked = right.blocked = 0;
    return;
  }
  control(left, last_left, seconds);
  control(right, last_right, seconds);
  if (left.blocked < kBlockedPeriods && right.blocked < kBlockedPeriods) return;
  stop();
  blocked = true;
  bridge.error(left.blocked < kBlockedPeriods ? F("right wheel does not turn as it is driven")
                                              : F("left wheel does not turn as it is driven"));
}

void setup() {
  safe_begin(kOutputs, bridge, heartbeats);
  for (uint8_t pin = 2; pin <= 5; ++pin) pinMode(pin, INPUT_PULLUP);
  attachInterrupt(digitalPinToInterrupt(2), count_left, CHANGE);
  attachInterrupt(digitalPinToInterrupt(3), count_right, CHANGE);
  Serial.begin(115200);
  bridge.on<CmdVel>(41, handle_cmd_vel);
  bridge.announce(kRows);
  bridge.settings(kSettings);
}

void loop() {
  static uint32_t measured_us = 0;
  bridge.update();
  const uint32_t now_us = micros();
  if (now_us - measured_us < kPeriodUs) return;
  const float seconds = (now_us - measured_us) * 1e-6f;
  measured_us = now_us;
  safe_update();
  const float last_left = left.speed;
  const float last_right = right.speed;
  bridge.time(now_us);
  measure(seconds);
  bridge.send(40, odom);
  drive(last_left, last_right, seconds);
}
