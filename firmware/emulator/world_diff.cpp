// A base with two driven wheels, as the example DiffDrive expects it: on each side an H-bridge, a motor with an encoder
// of two channels, and a share of the base's mass. The left motor is weaker than the right one. m, degrees, seconds;
// forces are those at the rim of a wheel.

#include <cmath>

#include "world.h"

namespace {

struct Pin {
  char port;
  int bit;
};

// Where a wheel is connected; the registers are those of the timer that drives its PWM pin.
struct Wiring {
  Pin pwm, forward, backward, channel_a, channel_b;
  uint16_t duty;
  uint8_t connected;  // the bit of TCCR1A
};
const uint16_t kTccr1a = 0x80;
const Wiring kLeft = {{'B', 1}, {'D', 7}, {'B', 0}, {'D', 2}, {'D', 4}, 0x88, 0x80};
const Wiring kRight = {{'B', 2}, {'B', 3}, {'B', 4}, {'D', 3}, {'D', 5}, 0x8A, 0x20};

class Wheel {
 public:
  Wheel(Mcu& mcu, const OutputPins& pins, Values& values, const std::string& name, const Wiring& wiring,
        double strength)
      : mcu_(mcu), pins_(pins), values_(values), name_(name), wiring_(wiring), strength_(strength) {
    mcu.on_write(wiring.duty, [this] { look_at_pins(); });
    for (const Pin& pin : {wiring.pwm, wiring.forward, wiring.backward}) {
      mcu.on_output_pin(pin.port, pin.bit, [this](bool) { look_at_pins(); });
    }
    values.reading(name + "_speed", [this] { return speed; });
    values.reading(name + "_turns", [this] { return turns_; });
    values.variable(name + "_held", &held);
    values.variable(name + "_encoder", [this] { return encoder_; }, [this](double intact) {
      encoder_ = intact;
      drive_encoder();
    });
    drive_encoder();
  }

  void look_at_pins() {
    const Pin& pwm = wiring_.pwm;
    const bool pwm_on = mcu_.data(kTccr1a) & wiring_.connected;
    const bool high = (!pwm_on || mcu_.input_pin(pwm.port, pwm.bit)) && pins_.level(pwm.port, pwm.bit);
    const int forward = pins_.level(wiring_.forward.port, wiring_.forward.bit);
    const int backward = pins_.level(wiring_.backward.port, wiring_.backward.bit);
    duty_ = high ? 255 : pwm_on ? mcu_.data(wiring_.duty) : 0;
    direction_ = forward - backward;
    values_.record(name_ + "_pwm", duty_);
    values_.record(name_ + "_inputs", forward + 2 * backward);
  }

  // A motor without a voltage turns freely.
  double force() const {
    const double driven = duty_ == 0 || direction_ == 0
                              ? 0
                              : strength_ * (direction_ * duty_ / 255.0 - speed / kFreeSpeed);
    return driven - kFriction * std::tanh(speed / kSlow);
  }

  void turn(double seconds) {
    turns_ += speed * seconds / (2 * M_PI * kRadius);
    drive_encoder();
  }

  double speed = 0;  // m/s at its rim
  double held = 0;   // 1: it cannot turn

 private:
  static constexpr double kRadius = 0.0325, kPulsesPerTurn = 11 * 30;
  static constexpr double kFreeSpeed = 0.75;              // at full duty without a load
  static constexpr double kFriction = 0.4, kSlow = 0.005;  // N; m/s below which it is less

  // A is ahead of B by a quarter of a pulse.
  void drive_encoder() {
    const double pulses = turns_ * kPulsesPerTurn;
    const double part = pulses - std::floor(pulses);
    mcu_.drive_pin(wiring_.channel_a.port, wiring_.channel_a.bit, encoder_ != 0 && part < 0.5);
    mcu_.drive_pin(wiring_.channel_b.port, wiring_.channel_b.bit, encoder_ != 0 && part >= 0.25 && part < 0.75);
  }

  Mcu& mcu_;
  const OutputPins& pins_;
  Values& values_;
  std::string name_;
  const Wiring& wiring_;
  double strength_;  // N at full duty while it stands still
  double encoder_ = 1;  // 0: its cable is off
  double turns_ = 0;
  int duty_ = 0;
  int direction_ = 0;
};

class DiffWorld : public World {
 public:
  explicit DiffWorld(Mcu& mcu)
      : mcu_(mcu),
        pins_(mcu, values),
        left_(mcu, pins_, values, "left", kLeft, 4.5),
        right_(mcu, pins_, values, "right", kRight, 5.0) {
    values.clock = [this] { return mcu_.seconds(); };
    mcu.after_reset = [this] { look_at_pins(); };
    mcu.on_write(kTccr1a, [this] { look_at_pins(); });
    look_at_pins();
    mcu.every(uint64_t(kFineStep * mcu.frequency()), [this] { step(); });
    values.reading("x", [this] { return x_; });
    values.reading("y", [this] { return y_; });
    values.reading("yaw", [this] { return yaw_ * 180 / M_PI; });
    values.record("led_builtin", mcu.output_pin('B', 5));
  }

 private:
  static constexpr double kFineStep = 100e-6;  // an encoder has an edge every 300 us at 0.5 m/s
  static constexpr double kTrack = 0.16, kMass = 1.2, kInertia = 0.006;  // m, kg, kg m^2

  void look_at_pins() {
    left_.look_at_pins();
    right_.look_at_pins();
  }

  void step() {
    if (pins_.step()) look_at_pins();
    const double left = left_.force(), right = right_.force();
    ahead_ += (left + right) / kMass * kFineStep;
    turn_ += (right - left) * kTrack / 2 / kInertia * kFineStep;
    left_.speed = left_.held != 0 ? 0 : ahead_ - turn_ * kTrack / 2;
    right_.speed = right_.held != 0 ? 0 : ahead_ + turn_ * kTrack / 2;
    ahead_ = (left_.speed + right_.speed) / 2;
    turn_ = (right_.speed - left_.speed) / kTrack;
    left_.turn(kFineStep);
    right_.turn(kFineStep);
    x_ += ahead_ * kFineStep * std::cos(yaw_ + turn_ * kFineStep / 2);
    y_ += ahead_ * kFineStep * std::sin(yaw_ + turn_ * kFineStep / 2);
    yaw_ += turn_ * kFineStep;
  }

  Mcu& mcu_;
  OutputPins pins_;
  Wheel left_, right_;
  double ahead_ = 0, turn_ = 0;        // m/s, rad/s
  double x_ = 0, y_ = 0, yaw_ = 0;     // m, m, rad
};

}  // namespace

std::unique_ptr<World> make_diff_world(Mcu& mcu) { return std::unique_ptr<World>(new DiffWorld(mcu)); }
