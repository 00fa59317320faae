// The main control board: a robot-ctrl-bus Slave with a lift, a gimbal, and smoke, temperature and
// humidity sensors.

#include <BusSlave.h>
#include <avr/sleep.h>
#include <avr_i2c.h>
#include <safe_board.h>

#include "board.h"
#include "sht3x.h"
#include "stepper.h"

// A reset does not turn the gimbal, and opening the port may reset the board, so the counts are kept through a reset.
static StepCount pan_count __attribute__((section(".noinit")));
static StepCount tilt_count __attribute__((section(".noinit")));

static const StepperAxis kLift = {kLiftStepPin, kLiftDirectionPin, kLiftStepsPerSecond, 0};
static const StepperAxis kPan = {kPanStepPin, kPanDirectionPin, kGimbalStepsPerSecond, &pan_count};
static const StepperAxis kTilt = {kTiltStepPin, kTiltDirectionPin, kGimbalStepsPerSecond, &tilt_count};

static Sht3x sht3x;

static BusSlave bus(Serial);

struct PACKED Lift {
  uint8_t direction;  // 0 up, 1 down
  uint8_t distance_mm;
};
struct PACKED Gimbal {
  uint8_t direction;  // 0 left, 1 right, 2 up, 3 down
  uint8_t degrees;
};
struct PACKED Environment {
  uint16_t smoke;       // of the ADC, 0 … 1023
  int16_t temperature;  // 0.01 degrees Celsius
  uint16_t humidity;    // 0.01 %
};

static BusResult start(const StepperAxis& axis, bool positive, uint32_t steps, EndSwitchPin end_switch) {
  if (steps == 0) return BusResult::ok();
  stepper_start(axis, positive, steps, end_switch);
  return BusResult::pending();
}

// An open end switch refuses the move, or stops it.
static BusResult lift(const Lift& request) {
  if (request.direction > 1) return BusResult::failed(kErrorMalformed);
  const bool up = request.direction == 0;
  const EndSwitchPin end_switch = up ? kLiftTopPin : kLiftBottomPin;
  if (stepper_switch_open(end_switch)) return BusResult::failed(kErrorOperation);
  return start(kLift, up, uint32_t(request.distance_mm) * kLiftStepsPerMm, end_switch);
}

// The gimbal has no switches: its position is counted, and a move beyond the limit refused as a whole.
static BusResult gimbal(const Gimbal& request) {
  if (request.direction > 3) return BusResult::failed(kErrorMalformed);
  const bool pan = request.direction <= 1;
  const bool positive = request.direction == 0 || request.direction == 2;  // left, tilt up
  const StepperAxis& axis = pan ? kPan : kTilt;
  const int16_t limit = (pan ? kPanLimit : kTiltLimit) * kGimbalStepsPerDegree;
  const int16_t steps = request.degrees * kGimbalStepsPerDegree;
  const int16_t target = axis.count->steps() + (positive ? steps : -steps);
  if (target > limit || target < -limit) return BusResult::failed(kErrorOperation);
  return start(axis, positive, steps, 0);
}

static BusResult motion() {
  if (stepper_running()) return BusResult::pending();
  return stepper_steps_missed() == 0 ? BusResult::ok() : BusResult::failed(kErrorOperation);
}

static BusResult environment() {
  if (!sht3x.valid()) return BusResult::failed(kErrorOperation);
  const Environment reading = {static_cast<uint16_t>(analogRead(kSmokePin)), sht3x.temperature(), sht3x.humidity()};
  return BusResult::ok(reading);
}

#ifdef CUSTOM_MESSAGES
// An example of custom functions, and the stop that this board always has. With `bus/announcements: true` the
// bridge asks for their rows.
static const char kRows[] PROGMEM =
    "firmware: ctrl_board 2.0.0\n"
    "pump: {cmd2: 0x30, srv_type: std_srvs/SetBool, request: {layout: '<?', fields: [data]}, timeout: 2.0}\n"
    "halt: {cmd2: 0x2F, srv_type: std_srvs/Trigger, repeatable: true, interrupts: true}\n"
    "tank: {cmd2: 0x32, ros_type: sensor_msgs/FluidPressure, period: 2.0, frame_id: tank,"
    " reply: {layout: '<H', fields: [fluid_pressure], scale: 10, minimum: 0}, constants: {variance: 10000}}\n";

struct PACKED Pump {
  uint8_t on;
};
struct PACKED Tank {
  uint16_t decapascals;
};

static BusResult pump(const Pump& pump) {
  digitalWrite(kPumpPin, pump.on != 0);
  return BusResult::ok();
}

static BusResult tank() {
  const Tank tank = {static_cast<uint16_t>(analogRead(kTankPin) * 10)};
  return BusResult::ok(tank);
}
#endif

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
  safe_begin(kOutputs);
  pan_count.begin();
  tilt_count.begin();
  bus.on<Lift>(kFunctionLift, lift);
  bus.on<Gimbal>(kFunctionGimbal, gimbal);
  bus.on(kFunctionEnvironment, environment);
  bus.on_pending(motion);
  bus.on_stop(stepper_stop);
#ifdef CUSTOM_MESSAGES
  bus.on<Pump>(0x30, pump);
  bus.on(0x32, tank);
  bus.announce(kRows);
#endif
  pinMode(kLiftTopPin, INPUT_PULLUP);
  pinMode(kLiftBottomPin, INPUT_PULLUP);
  stepper_begin();
  Serial.begin(kBaud);
  i2c_begin();
}

void loop() {
  safe_update();
  bus.update();
  sht3x.poll(millis());
  sleep_until_interrupt();
}
