// The world of the control board: a lift with end switches and a two-axis gimbal, all on step and
// direction pins, a smoke sensor, and an SHT3x.

#include <cmath>

#include "world.h"

namespace {

// One stepper: counts the steps that its driver receives, and those that its rotor follows. From rest the rotor
// follows up to `pull_in_` steps a second; above this, its rate may rise by `kAcceleration`, up to `pull_out_`.
// A step that comes sooner is lost, and the rotor stops.
class Axis {
 public:
  Axis(Mcu& mcu, const OutputPins& pins, Values& values, const std::string& name, double steps_per_unit, double start,
       char step_port, int step_bit, char direction_port, int direction_bit)
      : mcu_(mcu), steps_per_unit_(steps_per_unit), start_(start) {
    look_at_pins = [=, &pins] {
      const bool level = pins.level(step_port, step_bit);
      if (level && !level_) step(pins.level(direction_port, direction_bit));
      level_ = level;
    };
    mcu.on_output_pin(step_port, step_bit, [this](bool) { look_at_pins(); });
    values.reading(name + "_position", [this] { return position(); });
    values.reading(name + "_steps", [this] { return double(steps_); });
    values.reading(name + "_moves", [this] { return double(moves_); });
    values.reading(name + "_last_step", [this] { return last_step_; });
    values.reading(name + "_top_rate", [this] { return top_rate_; });
    values.reading(name + "_lost_steps", [this] { return double(lost_steps_); });
    values.variable(name + "_pull_in", &pull_in_);
    values.variable(name + "_pull_out", &pull_out_);
  }

  // To be called when the pins may have changed without being written.
  std::function<void()> look_at_pins;

  // Position of the load, in mm or degrees.
  double position() const { return start_ + rotor_ / steps_per_unit_; }

 private:
  // After a pause this long, or a change of direction, the next step begins another move.
  static constexpr double kPause = 0.02;
  static constexpr double kAcceleration = 6000;  // steps/s²
  static constexpr double kJitter = 1.25;        // tolerance of the time between two steps

  void step(bool positive) {
    const double now = mcu_.seconds();
    const double pause = now - last_step_;
    const bool turned = moves_ == 0 || positive != positive_;
    if (turned || pause > kPause) ++moves_;
    const double rate = 1 / pause;
    top_rate_ = turned || pause > kPause ? 0 : std::fmax(top_rate_, rate);
    const double allowed = std::fmin(pull_out_, std::fmax(pull_in_, turned ? 0 : rate_ + kAcceleration * pause));
    const bool taken = moves_ == 0 || rate <= allowed * kJitter;
    rate_ = taken ? rate : 0;
    last_step_ = now;
    positive_ = positive;
    steps_ += positive ? 1 : -1;
    if (taken) {
      rotor_ += positive ? 1 : -1;
    } else {
      ++lost_steps_;
    }
  }

  Mcu& mcu_;
  double steps_per_unit_;
  double start_;
  double pull_in_ = 350;    // steps/s
  double pull_out_ = 2500;  // steps/s
  long steps_ = 0;
  long rotor_ = 0;
  long lost_steps_ = 0;
  double rate_ = 0;
  double top_rate_ = 0;  // of the latest move
  unsigned moves_ = 0;
  double last_step_ = 0;
  bool positive_ = false;
  bool level_ = false;
};

// Single-shot measurements without clock stretching: two command bytes, 15 ms, six bytes with CRCs.
class Sht3x : public I2cDevice {
 public:
  explicit Sht3x(Mcu& mcu) : mcu_(mcu) {}

  bool start(bool read) override {
    if (!present) return false;
    count_ = 0;
    if (!read) return true;
    if (hangs != 0) return false;
    if (mcu_.seconds() < ready_at_) return false;  // still measuring: the address is not acknowledged
    put(0, (temperature + 45) / 175 * 65535);
    put(3, humidity / 100 * 65535);
    ready_at_ = INFINITY;
    return true;
  }

  void write(uint8_t byte) override {
    command_ = uint16_t(command_ << 8 | byte);
    if (++count_ == 2 && command_ == 0x30A2) power_on();  // a soft reset
    if (count_ == 2 && (command_ >> 8) == 0x24) ready_at_ = mcu_.seconds() + 0.015;
  }

  uint8_t read() override { return count_ < 6 ? result_[count_++] : 0xFF; }
  void power_on() override {
    ready_at_ = INFINITY;
    hangs = 0;
  }

  void set_present(double now_present) {
    if (present == 0 && now_present != 0) power_on();
    present = now_present;
  }

  double present = 1;
  double hangs = 0;           // it takes commands and measures nothing, until it is reset
  double temperature = 22.5;  // degrees Celsius
  double humidity = 45;       // %

 private:
  void put(int at, double value) {
    const uint16_t raw = uint16_t(std::lround(std::fmax(0, std::fmin(65535, value))));
    result_[at] = uint8_t(raw >> 8);
    result_[at + 1] = uint8_t(raw);
    uint8_t crc = 0xFF;
    for (int i = 0; i < 2; ++i) {
      crc ^= result_[at + i];
      for (int bit = 0; bit < 8; ++bit) crc = uint8_t(crc & 0x80 ? crc << 1 ^ 0x31 : crc << 1);
    }
    result_[at + 2] = crc;
  }

  Mcu& mcu_;
  uint16_t command_ = 0;
  int count_ = 0;
  double ready_at_ = INFINITY;
  uint8_t result_[6] = {0, 0, 0, 0, 0, 0};
};

class CtrlWorld : public World {
 public:
  CtrlWorld(Mcu& mcu, bool still)
      : mcu_(mcu),
        pins_(mcu, values),
        lift_(mcu, pins_, values, "lift", 25, 300, 'D', 3, 'D', 4),
        pan_(mcu, pins_, values, "pan", 10, 0, 'D', 5, 'D', 6),
        tilt_(mcu, pins_, values, "tilt", 10, 0, 'D', 7, 'B', 0),
        sht3x_(mcu) {
    values.clock = [this] { return mcu_.seconds(); };
    mcu.attach_i2c(0x44, &sht3x_);
    mcu.adc_volts = [this](int channel) {
      return channel > 1 ? 0 : ((channel == 0 ? smoke_ : tank_) + 0.5) * 5 / 1024;
    };
    mcu.on_output_pin('B', 3, [this](bool) { look_at_pins(); });
    mcu.on_output_pin('D', 5, [this](bool) { look_at_pins(); });
    mcu.after_reset = [this] { look_at_pins(); };
    look_at_pins();
    mcu.every(uint64_t(kStep * mcu.frequency()), [this, still] { step(still); });
    drive_switches();
    values.variable("smoke", &smoke_);
    values.variable("tank", &tank_);
    values.variable("temperature", &sht3x_.temperature);
    values.variable("humidity", &sht3x_.humidity);
    values.variable("sht3x_present", [this] { return sht3x_.present; },
                    [this](double present) { sht3x_.set_present(present); });
    values.variable("sht3x_hangs", &sht3x_.hangs);
    values.variable("lift_switch_spike", [this] { return std::fmax(0, spike_end_ - mcu_.seconds()); },
                    [this](double seconds) {
                      spike_end_ = mcu_.seconds() + seconds;
                      drive_switches();
                    });
    values.variable("lift_bottom", &lift_bottom_);
    values.variable("lift_top", &lift_top_);
    for (int end = 0; end < 2; ++end) {
      values.variable(end == 0 ? "lift_bottom_wire" : "lift_top_wire", [this, end] { return wires_[end]; },
                      [this, end](double intact) {
                        wires_[end] = intact;
                        drive_switches();
                      });
    }
  }

 private:
  void look_at_pins() {
    for (Axis* axis : {&lift_, &pan_, &tilt_}) axis->look_at_pins();
    values.record("pump", pins_.level('B', 3));
    values.record("door", pins_.level('D', 5));  // of the example Slave; the control board has its pan there
  }

  void step(bool still) {
    if (pins_.step()) look_at_pins();
    const bool top = lift_.position() >= lift_top_;
    const bool bottom = lift_.position() <= lift_bottom_;
    const bool spike = mcu_.seconds() < spike_end_;
    if (top != at_top_ || bottom != at_bottom_ || spike != spike_) drive_switches();
    if (still) return;
    const double now = mcu_.seconds();
    smoke_ = wave(now, 20, 90, 160);
    sht3x_.temperature = wave(now, 60, 21, 24);
    sht3x_.humidity = wave(now, 45, 40, 50);
  }

  // The end switches are normally closed, to ground: at the end, or with a broken wire, the pull-up sets the pin high.
  void drive_switches() {
    at_top_ = lift_.position() >= lift_top_;
    at_bottom_ = lift_.position() <= lift_bottom_;
    spike_ = mcu_.seconds() < spike_end_;
    mcu_.drive_pin('B', 1, at_top_ || wires_[1] == 0 || spike_);
    mcu_.drive_pin('B', 2, at_bottom_ || wires_[0] == 0 || spike_);
  }

  Mcu& mcu_;
  OutputPins pins_;
  Axis lift_, pan_, tilt_;
  Sht3x sht3x_;
  double smoke_ = 120;       // raw ADC
  double tank_ = 300;        // likewise, of the example of custom functions
  double lift_bottom_ = 0;   // mm
  double lift_top_ = 600;    // mm
  double wires_[2] = {1, 1};  // of the bottom and the top switch; 0: broken
  double spike_end_ = 0;  // of a pulse that both switches' wires pick up
  bool spike_ = false;
  bool at_top_ = false;
  bool at_bottom_ = false;
};

}  // namespace

std::unique_ptr<World> make_ctrl_world(Mcu& mcu, bool still) {
  return std::unique_ptr<World>(new CtrlWorld(mcu, still));
}
