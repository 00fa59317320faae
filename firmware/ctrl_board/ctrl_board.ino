// The main control board: a robot-ctrl-bus Slave with a lift, a gimbal, and smoke, temperature and
// humidity sensors.

#include <Wire.h>
#include <avr/sleep.h>
#include <robot_ctrl_bus.h>

#include "board.h"
#include "sht3x.h"
#include "stepper.h"

using namespace serial_communication;

struct SerialSink {
  void operator()(const uint8_t* bytes, size_t size) const { Serial.write(bytes, size); }
};

static const StepperAxis kLift = {kLiftStepPin, kLiftDirectionPin, kLiftStepsPerSecond};
static const StepperAxis kPan = {kPanStepPin, kPanDirectionPin, kGimbalStepsPerSecond};
static const StepperAxis kTilt = {kTiltStepPin, kTiltDirectionPin, kGimbalStepsPerSecond};

static Sht3x sht3x;

#ifdef OWN_MESSAGES
// An example of functions of one's own, the rows `pump` and `tank` of config/own_messages.yaml.
const uint8_t kFunctionPump = 0x30;
const uint8_t kFunctionTank = 0x32;

struct PACKED Pump {
  uint8_t on;
};
struct PACKED Tank {
  uint16_t decapascals;
};

static BusResult pump(const uint8_t* data, uint16_t size) {
  Pump pump;
  if (!from_bytes(data, size, &pump)) return BusResult::failed(kErrorMalformed);
  digitalWrite(kPumpPin, pump.on != 0);
  return BusResult::ok();
}

static BusResult tank() {
  const Tank tank = {static_cast<uint16_t>(analogRead(kTankPin) * 10)};
  return BusResult::ok(tank);
}
#endif

class ControlBoard : public BusHandler {
 public:
  BusResult request(uint8_t cmd2, const uint8_t* data, uint16_t size) override {
    switch (cmd2) {
      case kFunctionLift:
        return size == 2 && data[0] <= 1 ? lift(data[0] == 0, data[1]) : BusResult::failed(kErrorMalformed);
      case kFunctionGimbal:
        return size == 2 && data[0] <= 3 ? gimbal(data[0], data[1]) : BusResult::failed(kErrorMalformed);
      case kFunctionEnvironment:
        return environment();
#ifdef OWN_MESSAGES
      case kFunctionPump:
        return pump(data, size);
      case kFunctionTank:
        return tank();
#endif
      default:
        return BusResult::failed(kErrorUnsupported);
    }
  }

  BusResult poll() override {
    if (stepper_running()) return BusResult::pending();
    return stepper_steps_missed() == 0 ? BusResult::ok() : BusResult::failed(kErrorOperation);
  }

 private:
  // A closed end switch refuses the move, or stops it.
  static BusResult lift(bool up, uint8_t distance_mm) {
    const EndSwitchPin end_switch = up ? kLiftTopPin : kLiftBottomPin;
    if (digitalRead(end_switch) == LOW) return BusResult::failed(kErrorOperation);
    return start(kLift, up, uint32_t(distance_mm) * kLiftStepsPerMm, end_switch);
  }

  // The gimbal has no switches: its position is counted, and a move beyond the limit refused as a whole.
  BusResult gimbal(uint8_t direction, uint8_t angle) {
    const bool pan = direction <= 1;
    const bool positive = direction == 0 || direction == 2;  // left, tilt up
    int16_t& position = pan ? pan_ : tilt_;
    const int16_t limit = pan ? kPanLimit : kTiltLimit;
    const int16_t target = position + (positive ? angle : -int16_t(angle));
    if (target > limit || target < -limit) return BusResult::failed(kErrorOperation);
    position = target;
    return start(pan ? kPan : kTilt, positive, uint32_t(angle) * kGimbalStepsPerDegree, 0);
  }

  static BusResult start(const StepperAxis& axis, bool positive, uint32_t steps, EndSwitchPin end_switch) {
    if (steps == 0) return BusResult::ok();
    stepper_start(axis, positive, steps, end_switch);
    return BusResult::pending();
  }

  static BusResult environment() {
    if (!sht3x.valid(millis())) return BusResult::failed(kErrorOperation);
    BusResult result = BusResult::ok();
    result.append_uint16(analogRead(kSmokePin));
    result.append_uint16(uint16_t(sht3x.temperature()));
    result.append_uint16(sht3x.humidity());
    return result;
  }

  int16_t pan_ = 0;   // degrees from where it stood at power-on
  int16_t tilt_ = 0;
};

static ControlBoard board;
static RobotCtrlBusSlave<SerialSink, 300> slave{SerialSink(), board};

static void sleep_until_interrupt() {
  set_sleep_mode(SLEEP_MODE_IDLE);
  cli();
  if (Serial.available() == 0 || !slave.ready()) {
    sleep_enable();
    sei();  // the instruction after it still runs before any interrupt: no byte can slip in between
    sleep_cpu();
    sleep_disable();
  }
  sei();
}

void setup() {
  const StepperAxis axes[] = {kLift, kPan, kTilt};
  for (const StepperAxis& axis : axes) {
    pinMode(axis.step_pin, OUTPUT);
    pinMode(axis.direction_pin, OUTPUT);
  }
#ifdef OWN_MESSAGES
  pinMode(kPumpPin, OUTPUT);
#endif
  pinMode(kLiftTopPin, INPUT_PULLUP);
  pinMode(kLiftBottomPin, INPUT_PULLUP);
  stepper_begin();
  Serial.begin(kBaud);
  Wire.begin();
  Wire.setClock(400000);
  Wire.setWireTimeout(3000, true);
}

void loop() {
  slave.poll(millis());
  while (slave.ready() && Serial.available() > 0) slave.feed(Serial.read(), millis());
  sht3x.poll(millis());
  sleep_until_interrupt();
}
