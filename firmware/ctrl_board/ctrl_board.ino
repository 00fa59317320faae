// The main control board: a robot-ctrl-bus Slave with a lift, a gimbal, and smoke, temperature and
// humidity sensors.

#include <avr/sleep.h>
#include <avr_i2c.h>
#include <robot_ctrl_bus.h>

#include "board.h"
#include "sht3x.h"
#include "stepper.h"

using namespace serial_communication;

struct SerialSink {
  void operator()(const uint8_t* bytes, size_t size) const { Serial.write(bytes, size); }
};

// A reset does not turn the gimbal, and opening the port may reset the board: the counts outlive it.
static StepCount pan_count __attribute__((section(".noinit")));
static StepCount tilt_count __attribute__((section(".noinit")));

static const StepperAxis kLift = {kLiftStepPin, kLiftDirectionPin, kLiftStepsPerSecond, 0};
static const StepperAxis kPan = {kPanStepPin, kPanDirectionPin, kGimbalStepsPerSecond, &pan_count};
static const StepperAxis kTilt = {kTiltStepPin, kTiltDirectionPin, kGimbalStepsPerSecond, &tilt_count};

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
      case kFunctionStop:  // the motion has ended by now
        return size == 0 ? BusResult::ok() : BusResult::failed(kErrorMalformed);
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

  // A stop ends the motion, and takes the place of all motions that wait.
  bool heard(uint8_t cmd2) override {
    if (cmd2 != kFunctionStop) return false;
    stepper_stop();
    return true;
  }

 private:
  // An open end switch refuses the move, or stops it.
  static BusResult lift(bool up, uint8_t distance_mm) {
    const EndSwitchPin end_switch = up ? kLiftTopPin : kLiftBottomPin;
    if (digitalRead(end_switch) == HIGH) return BusResult::failed(kErrorOperation);
    return start(kLift, up, uint32_t(distance_mm) * kLiftStepsPerMm, end_switch);
  }

  // The gimbal has no switches: its position is counted, and a move beyond the limit refused as a whole.
  static BusResult gimbal(uint8_t direction, uint8_t angle) {
    const bool pan = direction <= 1;
    const bool positive = direction == 0 || direction == 2;  // left, tilt up
    const StepperAxis& axis = pan ? kPan : kTilt;
    const int16_t limit = (pan ? kPanLimit : kTiltLimit) * kGimbalStepsPerDegree;
    const int16_t steps = angle * kGimbalStepsPerDegree;
    const int16_t target = axis.count->steps + (positive ? steps : -steps);
    if (target > limit || target < -limit) return BusResult::failed(kErrorOperation);
    return start(axis, positive, steps, 0);
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
};

static ControlBoard board;
static RobotCtrlBusSlave<SerialSink, 300> slave{SerialSink(), board};

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
  const StepperAxis axes[] = {kLift, kPan, kTilt};
  for (const StepperAxis& axis : axes) {
    pinMode(axis.step_pin, OUTPUT);
    pinMode(axis.direction_pin, OUTPUT);
  }
  pan_count.begin();
  tilt_count.begin();
#ifdef OWN_MESSAGES
  pinMode(kPumpPin, OUTPUT);
#endif
  pinMode(kLiftTopPin, INPUT_PULLUP);
  pinMode(kLiftBottomPin, INPUT_PULLUP);
  stepper_begin();
  Serial.begin(kBaud);
  i2c_begin();
}

void loop() {
  const uint32_t now = millis();  // whatever arrived before it is fed before poll() looks at the silence
  while (Serial.available() > 0) slave.feed(Serial.read(), now);
  slave.poll(now);
  sht3x.poll(millis());
  sleep_until_interrupt();
}
