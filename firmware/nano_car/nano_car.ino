// The model car's Arduino Nano: takes speed, steering, LED and heartbeat packets, sends encoder ticks,
// steering feedback, battery voltage and the IMU's orientation.

#include <arduino_packets.h>
#include <avr_i2c.h>
#include <avr/sleep.h>

#include "board.h"
#include "drive.h"
#include "imu.h"

using serial_communication::ImuData;
using serial_communication::MessageType;
using serial_communication::Packet;
using serial_communication::PacketDecoder;
using serial_communication::PacketSender;

struct SerialSink {
  void operator()(const uint8_t* bytes, size_t size) const { Serial.write(bytes, size); }
};

static PacketSender<SerialSink> sender{SerialSink()};
static PacketDecoder<40> decoder;
static Imu imu;

static bool imu_present = false;
static bool calibrating = false;
static uint8_t imu_retry_beats = 0;

// Which lamps the last LED command wants, and the beat counter that makes the indicators blink.
static bool lamp_left = false;
static bool lamp_right = false;
static bool lamp_brake = false;
static uint8_t blink_beats = 0;

// Sums of the battery's readings: one a second, three of them in the average.
static uint32_t battery_sums[3];
static uint8_t battery_seconds = 0;
static uint8_t battery_readings = 0;

static void log_text(MessageType severity, const __FlashStringHelper* text) {
  char buffer[48];
  strlcpy_P(buffer, reinterpret_cast<PGM_P>(text), sizeof buffer);
  sender.send_text(severity, buffer);
}

static void start_imu() {
  imu_present = imu.begin();
  if (!imu_present) {
    log_text(MessageType::Error, F("IMU does not answer"));
  } else if (imu.calibrated()) {
    log_text(MessageType::Info, F("IMU ready"));
  } else {
    log_text(MessageType::Warn, F("IMU ready, not calibrated"));
  }
}

static void handle_led(const Packet& packet) {
  lamp_brake = packet.text_is("brake");
  lamp_left = packet.text_is("left") || packet.text_is("hazard");
  lamp_right = packet.text_is("right") || packet.text_is("hazard");
  blink_beats = 0;
  if (!lamp_brake && !lamp_left && !lamp_right && !packet.text_is("disable")) {
    log_text(MessageType::Warn, F("unknown LED command"));
  }
}

#ifdef OWN_MESSAGES
// An example of messages of one's own, the rows `force` and `gripper` of config/own_messages.yaml.
struct PACKED Force {
  int16_t centinewtons;
};
struct PACKED Gripper {
  int16_t position;  // 0.1 mm, -1000 … 1000
  uint8_t force;     // 1/255
};

static void send_force() {
  const Force force = {static_cast<int16_t>(analogRead(kForcePin) * 29L)};  // 0 … 297 N
  sender.send(32, force);
}

static void handle_gripper(const Gripper& gripper) {
  const int16_t position = constrain(gripper.position, -1000, 1000);
  analogWrite(kGripperPin, gripper.force > 0 ? (position + 1000L) * 255 / 2000 : 0);
}
#endif

static void handle(const Packet& packet) {
#ifdef OWN_MESSAGES
  Gripper gripper;
  if (packet.is(48, &gripper)) handle_gripper(gripper);
#endif
  switch (packet.type) {
    case MessageType::Heartbeat:
      drive_heartbeat();
      break;
    case MessageType::SpeedCmd:
      drive_set_speed(packet.speed());
      break;
    case MessageType::SteeringCmd:
      drive_set_steering(packet.value());
      break;
    case MessageType::LedCmd:
      handle_led(packet);
      break;
    case MessageType::ImuCalibration:
      drive_set_speed(0);
      if (imu_present) {
        imu.start_calibration();
        calibrating = true;
        log_text(MessageType::Info, F("IMU calibration: do not move the car"));
      } else {
        log_text(MessageType::Error, F("IMU does not answer"));
      }
      break;
    default:
      break;  // a type that only the board sends
  }
}

static void continue_calibration() {
  switch (imu.calibrate()) {
    case Imu::Done:
      calibrating = false;
      log_text(MessageType::Info, F("IMU calibrated, IMU ready"));
      break;
    case Imu::Moved:
      calibrating = false;
      log_text(MessageType::Warn, F("car moved, calibration dropped"));
      break;
    case Imu::Failed:
      calibrating = imu_present = false;
      log_text(MessageType::Error, F("IMU does not answer"));
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
  if (!imu_present) {
    if (++imu_retry_beats == 100) {
      imu_retry_beats = 0;
      start_imu();
    }
    return;
  }
  ImuData data;
  imu_present = imu.update(beats * 0.01f, &data);
  if (imu_present) {
    sender.send_imu(data);
  } else {
    log_text(MessageType::Error, F("IMU does not answer"));
  }
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
  sender.send_voltage(average * (kAdcReference * kBatteryDivider / 1024));
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
    sei();  // the instruction after it still runs before any interrupt: no byte can slip in between
    sleep_cpu();
    sleep_disable();
  }
  sei();
}

void setup() {
#ifdef OWN_MESSAGES
  decoder.accept<Gripper>(48);
#endif
  pinMode(kLedLeftPin, OUTPUT);
  pinMode(kLedRightPin, OUTPUT);
  pinMode(kLedBrakePin, OUTPUT);
  drive_begin();
  Serial.begin(kBaud);
  Serial.write(uint8_t(0));  // ends a packet that a reset has cut off
  serial_communication::i2c_begin();
  start_imu();
}

void loop() {
  while (Serial.available() > 0) {
    const bool complete = decoder.feed(drive_read(), millis());
    // A calibrating board takes its input and drops it: nothing may be carried out minutes later.
    if (complete && !calibrating) handle(decoder.packet());
  }
  if (drive_take_heartbeat_lost()) log_text(MessageType::Warn, F("heartbeat lost, motor stopped"));

  uint8_t ticks;
  const uint8_t beats = drive_take_beats(&ticks);
  if (beats > 0) {
    sender.send_ticks(ticks);
    sender.send_steering_angle(analogRead(kSteeringFeedbackPin));
    update_imu(beats);
    update_battery();
    update_lamps();
#ifdef OWN_MESSAGES
    send_force();
#endif
  }
  sleep_until_interrupt();
}
