// The sensor board: two VL53L0X behind a TCA9548A and a BNO055, reported in a status frame 20 times a second.
// Meant for an ESP32; the same program runs on an ATmega328P with other sensor access (see sensors.h).

#include <stx_etx.h>

#include "sensors.h"
#if defined(ARDUINO_ARCH_AVR)
#include <avr/sleep.h>
#endif

using namespace serial_communication;

struct SerialSink {
  void operator()(const uint8_t* bytes, size_t size) const { Serial.write(bytes, size); }
};

static const uint32_t kBaud = 115200;
static const uint32_t kFramePeriodMs = 50;
// A sensor ranges every 33 ms; one that is silent for this long has timed out, and is started again.
static const uint32_t kRangeTimeoutMs = 200;
static const uint32_t kRestartMs = 1000;

static StxEtxSender<SerialSink> sender{SerialSink()};
static SensorStatus status = {{kRangeTimedOut, kRangeTimedOut}, 0, 0, 0};

struct RangeState {
  uint32_t read_ms;
  uint32_t started_ms;
};
static RangeState range_states[2];
static bool attitude_running = false;
static uint32_t attitude_started_ms = 0;
static uint32_t frame_ms = 0;

static void update_range(uint8_t sensor, uint32_t now) {
  RangeState& state = range_states[sensor];
  uint16_t millimetres;
  if (range_read(sensor, &millimetres)) {
    state.read_ms = now;
    status.range_mm[sensor] = millimetres;
  } else if (now - state.read_ms >= kRangeTimeoutMs) {
    status.range_mm[sensor] = kRangeTimedOut;
    if (now - state.started_ms >= kRestartMs) {
      state.started_ms = now;
      range_begin(sensor);
    }
  }
}

static void update_attitude(uint32_t now) {
  if (!attitude_running && now - attitude_started_ms >= kRestartMs) {
    attitude_started_ms = now;
    attitude_running = attitude_begin();
  }
  if (!attitude_running) return;
  Attitude attitude;
  attitude_running = attitude_read(&attitude);
  if (!attitude_running) return;
  status.yaw = attitude.yaw;
  status.pitch = attitude.pitch;
  status.roll = attitude.roll;
}

void setup() {
  Serial.begin(kBaud);
  sensors_begin();
  for (uint8_t sensor = 0; sensor < 2; ++sensor) range_begin(sensor);
  attitude_running = attitude_begin();
}

void loop() {
  const uint32_t now = millis();
  // On the ESP32 millis() may have run on during a slow start-up of the sensors.
  if (now - frame_ms >= kFramePeriodMs) {
    frame_ms = now - frame_ms >= 2 * kFramePeriodMs ? now : frame_ms + kFramePeriodMs;
    update_range(0, now);
    update_range(1, now);
    update_attitude(now);
    sender.send_sensor_status(status);
  }
#if defined(ARDUINO_ARCH_AVR)
  set_sleep_mode(SLEEP_MODE_IDLE);
  sleep_mode();
#else
  delay(1);
#endif
}
