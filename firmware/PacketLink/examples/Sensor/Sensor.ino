// A sensor board, which only sends: the status of its range sensors and its IMU, and a custom value, which it
// announces. Any AVR or ESP32. On the computer: mcu/status and the like, and mcu/cliff.
//
// The port belongs to the bridge: do not Serial.print to it.

#include <FrameLink.h>

const char kRows[] PROGMEM =
    "firmware: sensor 1.0\n"
    "cliff: {type: 0x20, ros_type: sensor_msgs/Range, layout: '<H', fields: [range], scale: 0.001}\n";

struct PACKED Cliff {
  uint16_t millimetres;
};

FrameLink bridge(Serial);

void setup() {
  Serial.begin(115200);
  bridge.announce(kRows);
}

void loop() {
  static uint32_t sent_ms = 0;
  bridge.update();
  if (millis() - sent_ms < 50) return;
  sent_ms += 50;

  bridge.time(micros());  // when the status is measured
  SensorStatus status;
  status.range_mm[0] = analogRead(A0);
  status.range_mm[1] = kRangeTimedOut;            // this sensor has no reading
  status.yaw = 0;                                 // 0.01 degree, clockwise, 0 … 35999
  status.pitch = status.roll = kAngleUnknown;     // there is no IMU: the bridge publishes none
  bridge.send_sensor_status(status);

  Cliff cliff;
  cliff.millimetres = analogRead(A3);
  bridge.send(0x20, cliff);
}
