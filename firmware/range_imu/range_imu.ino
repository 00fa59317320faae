// The sensor board: two VL53L0X behind a TCA9548A and a BNO055, reported in a status frame 20 times a second.
// Meant for an ESP32; the same program runs on an ATmega328P with other sensor access (see sensors.h).

#include <FrameLink.h>
#include <safe_board.h>

#include "sensors.h"
#if defined(ARDUINO_ARCH_AVR)
#include <avr/sleep.h>
#endif

static const uint32_t kBaud = 115200;
static const uint32_t kFramePeriodMs = 50;
// A sensor ranges every 33 ms. Without a measurement for this time it has timed out, and is started again.
static const uint32_t kRangeTimeoutMs = 200;
static const uint32_t kRestartMs = 1000;

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
  } else if (now - read_ms[sensor] >= kRangeTimeoutMs) {
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
}

void loop() {
  safe_update();
  const uint32_t now = millis();
  // After the slow start of a sensor the next frames are due from now on, without a burst.
  if (now - frame_ms >= kFramePeriodMs) {
    frame_ms = now - frame_ms >= 2 * kFramePeriodMs ? now : frame_ms + kFramePeriodMs;
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
