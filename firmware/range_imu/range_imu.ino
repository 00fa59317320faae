// The sensor board: two VL53L0X behind a TCA9548A and a BNO055, reported in a status frame 20 times a second, or as a
// setting has it.
// Meant for an ESP32; the same program runs on an ATmega328P with other sensor access (see sensors.h).

#include <FrameLink.h>
#include <safe_board.h>

#include "sensors.h"
#if defined(ARDUINO_ARCH_AVR)
#include <avr/sleep.h>
#endif

static const uint32_t kBaud = 115200;
static const uint32_t kRestartMs = 1000;

// Numbers that the bridge may change while the program runs. A sensor ranges every 33 ms; without a measurement for
// range_timeout it has timed out, and is started again.
//      number, variable, type, value at the start, minimum, maximum, unit, description
#define SETTINGS(SETTING)                                                                               \
  SETTING(1, frame_period, uint16_t, 50, 20, 500, "ms", "from one status frame to the next")            \
  SETTING(2, range_timeout, uint16_t, 200, 100, 1000, "ms", "without a measurement: there is no range")

SETTINGS(SETTING_VARIABLE)
static constexpr Setting kSettings[] PROGMEM = {SETTINGS(SETTING_ENTRY)};
static const char kRows[] PROGMEM = "firmware: range_imu 2.0.0\n" SETTINGS(SETTING_ROW);

static FrameLink bridge(Serial);
static SensorStatus status = {{kRangeTimedOut, kRangeTimedOut}, 0, kAngleUnknown, kAngleUnknown};

static uint32_t read_ms[2];
static uint32_t started_ms[3] = {0 - kRestartMs, 0 - kRestartMs, 0 - kRestartMs};  // two ranges, attitude
static uint32_t frame_ms = 0;

static void update_range(uint8_t sensor, uint32_t now) {
  uint16_t millimetres;
  if (range_read(sensor, &millimetres)) {
    read_ms[sensor] = now;
    status.range_mm[sensor] = millimetres;
  } else if (now - read_ms[sensor] >= range_timeout) {
    status.range_mm[sensor] = kRangeTimedOut;
  }
}

// A sensor without measurements is started again once a second, at most one a frame: a start is slow on the ESP32.
static void start_one(uint32_t now) {
  for (uint8_t sensor = 0; sensor < 3; ++sensor) {
    const bool silent = sensor < 2 ? status.range_mm[sensor] == kRangeTimedOut : status.pitch == kAngleUnknown;
    if (!silent || now - started_ms[sensor] < kRestartMs) continue;
    started_ms[sensor] = now;
    if (sensor < 2) {
      range_begin(sensor);
    } else {
      attitude_begin();
    }
    return;
  }
}

static void update_attitude() {
  Attitude attitude;
  if (attitude_read(&attitude)) {
    status.yaw = attitude.yaw;
    status.pitch = attitude.pitch;
    status.roll = attitude.roll;
  } else {
    status.pitch = status.roll = kAngleUnknown;
  }
}

void setup() {
  safe_begin();
  Serial.begin(kBaud);
  sensors_begin();
  bridge.announce(kRows);
  bridge.settings(kSettings);
}

void loop() {
  safe_update();
  bridge.update();
  const uint32_t now = millis();
  // After the slow start of a sensor the next frames are due from now on, without a burst.
  if (now - frame_ms >= frame_period) {
    frame_ms = now - frame_ms >= 2ul * frame_period ? now : frame_ms + frame_period;
    bridge.time(micros());
    update_range(0, now);
    update_range(1, now);
    update_attitude();
    bridge.send_sensor_status(status);
    start_one(now);
  }
#if defined(ARDUINO_ARCH_AVR)
  set_sleep_mode(SLEEP_MODE_IDLE);
  sleep_mode();
#else
  delay(1);
#endif
}
