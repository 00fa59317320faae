// The model car's Arduino Nano: takes speed, steering, LED and heartbeat packets, sends encoder ticks,
// steering feedback, battery voltage and the IMU's orientation.

#include <PacketLink.h>
#include <avr_i2c.h>
#include <avr/sleep.h>
#include <rate_limit.h>

#include "board.h"
#include "drive.h"
#include "imu.h"

// Numbers that the bridge may change while the program runs. None of them delays a stop.
//      number, variable, type, value at the start, minimum, maximum, unit, description
#define SETTINGS(SETTING)                                                                            \
  SETTING(1, motor_ramp, uint16_t, 0, 0, 2000, "ms", "time in which the speed rises from 0 to 1000") \
  SETTING(2, steering_range, uint16_t, 500, 50, 500, "us", "of the servo, to each side of 1500 us")  \
  SETTING(3, imu_rate, uint8_t, 100, 1, 100, "Hz", "IMU packets")

SETTINGS(SETTING_VARIABLE)
static constexpr Setting kSettings[] PROGMEM = {SETTINGS(SETTING_ENTRY)};

static PacketLink bridge(Serial);
static Imu imu;

static bool imu_started = false;
static bool imu_ready = false;  // it was started, and has had values
static bool calibrating = false;
static uint8_t imu_retry_beats = 0;
static uint8_t imu_failures = 0;  // since it was ready, modulo 10
static uint16_t imu_due = 0;      // 100: a packet is

static uint16_t steering_us = kServoCentreUs;  // as commanded

// The lamps of the last LED command, and the counter for the blinking of the indicators.
static bool lamp_left = false;
static bool lamp_right = false;
static bool lamp_brake = false;
static uint8_t blink_beats = 0;

// Sums of the battery readings: one a second, averaged over three.
static uint32_t battery_sums[3];
static uint8_t battery_seconds = 0;
static uint8_t battery_readings = 0;

// It is started again each second; every tenth failure is logged.
static void imu_failed() {
  imu_started = imu_ready = calibrating = false;
  if (imu_failures == 0) bridge.error(F("IMU does not answer"));
  if (++imu_failures == 10) imu_failures = 0;
}

static void start_imu() {
  imu_started = imu.begin();
  if (!imu_started) imu_failed();
}

// During a calibration the input is read and dropped, so that nothing is executed minutes later.
static void handle_speed(int16_t speed) {
  if (!calibrating) drive_set_speed(speed);
}

static void handle_steering(uint16_t pulse_us) {
  if (calibrating) return;
  steering_us = pulse_us;
  drive_set_steering(constrain(pulse_us, kServoCentreUs - steering_range, kServoCentreUs + steering_range));
}

static void handle_setting(uint8_t) {
  drive_set_ramp(motor_ramp);
  handle_steering(steering_us);
}

static bool same(const char* text, PGM_P other) { return strcmp_P(text, other) == 0; }

static void handle_led(const char* text) {
  if (calibrating) return;
  const bool hazard = same(text, PSTR("hazard"));
  lamp_brake = same(text, PSTR("brake"));
  lamp_left = hazard || same(text, PSTR("left"));
  lamp_right = hazard || same(text, PSTR("right"));
  blink_beats = 0;
  if (lamp_brake || lamp_left || lamp_right || same(text, PSTR("disable"))) return;
  static RateLimit limit;
  if (limit.passes(millis())) bridge.warn(F("unknown LED command"));
}

#ifdef CUSTOM_MESSAGES
// An example of custom messages, which the board announces: the bridge needs no rows for them.
static const char kRows[] PROGMEM =
    "firmware: nano_car 2.0.0\n"
    "force: {type: 32, ros_type: std_msgs/Float32, layout: '<h', fields: [data], scale: 0.01,"
    " minimum: 0, maximum: 300}\n"
    "gripper: {type: 48, direction: to_board, ros_type: geometry_msgs/Vector3, layout: '<hB', fields: [x, z],"
    " scale: [0.1, 0.00392156862745098], minimum: [-100, 0], maximum: [100, 1]}\n"
    SETTINGS(SETTING_ROW);

struct PACKED Force {
  int16_t centinewtons;
};
struct PACKED Gripper {
  int16_t position;  // 0.1 mm, -1000 … 1000
  uint8_t force;     // 1/255
};

static void send_force() {
  const Force force = {static_cast<int16_t>(analogRead(kForcePin) * 29L)};  // 0 … 297 N
  bridge.send(32, force);
}

static void handle_gripper(const Gripper& gripper) {
  if (calibrating) return;
  const int16_t position = constrain(gripper.position, -1000, 1000);
  analogWrite(kGripperPin, gripper.force > 0 ? (position + 1000L) * 255 / 2000 : 0);
}
#else
static const char kRows[] PROGMEM = "firmware: nano_car 2.0.0\n" SETTINGS(SETTING_ROW);
#endif

static void handle_calibration() {
  if (calibrating) return;
  drive_set_speed(0);
  if (!imu_ready) {
    static RateLimit limit;
    if (limit.passes(millis())) bridge.error(F("IMU does not answer"));
    return;
  }
  imu.start_calibration();
  calibrating = true;
  bridge.info(F("IMU calibration: do not move the car"));
}

static void continue_calibration() {
  switch (imu.calibrate()) {
    case Imu::Done:
      calibrating = false;
      bridge.info(F("IMU calibrated, IMU ready"));
      break;
    case Imu::Moved:
      calibrating = false;
      bridge.warn(F("car moved, calibration dropped"));
      break;
    case Imu::Failed:
      imu_failed();
      break;
    default:
      break;
  }
}

static void update_imu(uint8_t beats) {
  if (calibrating) {
    continue_calibration();
    return;
  }
  if (!imu_started) {
    if (++imu_retry_beats == 100) {
      imu_retry_beats = 0;
      start_imu();
    }
    return;
  }
  ImuData data;
  if (!imu.update(beats * 0.01f, &data)) {
    if (imu.lost()) imu_failed();
    return;
  }
  if (!imu_ready) {
    imu_ready = true;
    imu_failures = 0;
    imu.calibrated() ? bridge.info(F("IMU ready")) : bridge.warn(F("IMU ready, not calibrated"));
  }
  imu_due += imu_rate * beats;
  if (imu_due < 100) return;
  imu_due %= 100;
  bridge.send_imu(data);
}

static void update_lamps() {
  if (++blink_beats >= 70) blink_beats = 0;
  const bool bright = blink_beats < 35;
  digitalWrite(kLedLeftPin, lamp_left && bright);
  digitalWrite(kLedRightPin, lamp_right && bright);
  digitalWrite(kLedBrakePin, lamp_brake);
}

static void update_battery() {
  battery_sums[0] += analogRead(kBatteryPin);
  if (++battery_readings < 100) return;
  if (battery_seconds < 3) ++battery_seconds;
  const uint32_t sum = battery_sums[0] + battery_sums[1] + battery_sums[2];
  const float average = float(sum) / (100 * battery_seconds) + 0.5f;  // the ADC rounds down
  bridge.send_voltage(average * (kAdcReference * kBatteryDivider / 1024));
  battery_sums[2] = battery_sums[1];
  battery_sums[1] = battery_sums[0];
  battery_sums[0] = 0;
  battery_readings = 0;
}

static void sleep_until_interrupt() {
  set_sleep_mode(SLEEP_MODE_IDLE);
  cli();
  if (Serial.available() == 0) {
    sleep_enable();
    sei();  // the next instruction runs before any interrupt, so no byte can arrive in between
    sleep_cpu();
    sleep_disable();
  }
  sei();
}

void setup() {
  bridge.on_speed(handle_speed);
  bridge.on_steering(handle_steering);
  bridge.on_led(handle_led);
  bridge.on_calibration(handle_calibration);
#ifdef CUSTOM_MESSAGES
  bridge.on<Gripper>(48, handle_gripper);
#endif
  bridge.announce(kRows);
  bridge.settings(kSettings, handle_setting);
  pinMode(kLedLeftPin, OUTPUT);
  pinMode(kLedRightPin, OUTPUT);
  pinMode(kLedBrakePin, OUTPUT);
  drive_begin(bridge);
  Serial.begin(kBaud);
  Serial.write(uint8_t(0));  // ends a packet that a reset cut
  i2c_begin();
  start_imu();
}

void loop() {
  bridge.update();
  if (drive_take_heartbeat_lost()) bridge.warn(F("heartbeat lost, motor stopped"));

  uint8_t ticks;
  const uint8_t beats = drive_take_beats(&ticks);
  if (beats > 0) {
    bridge.time(micros());
    bridge.send_ticks(ticks);
    bridge.send_steering_angle(analogRead(kSteeringFeedbackPin));
    update_imu(beats);
    update_battery();
    update_lamps();
#ifdef CUSTOM_MESSAGES
    send_force();
#endif
  }
  sleep_until_interrupt();
}
