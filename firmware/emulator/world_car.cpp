// The model car: motor with encoder, steering servo with feedback, battery, and an MPU6050 that turns
// with the car. Angles are ROS's: degrees, yaw counter-clockwise, x forward, y left, z up.

#include <cmath>

#include "i2c_registers.h"
#include "world.h"

namespace {

const double kDegree = M_PI / 180;

// Data addresses of the ATmega328P's registers.
const uint16_t kOcr1al = 0x88, kOcr1ah = 0x89, kIcr1l = 0x86, kIcr1h = 0x87, kTccr1b = 0x81;
const uint16_t kOcr2a = 0xB3, kOcr2b = 0xB4, kTccr2a = 0xB0;

// An angle that moves to its set value smoothly, with limited acceleration.
class SmoothAngle {
 public:
  void set(double degrees) {
    from_ = value;
    to_ = degrees;
    elapsed_ = 0;
    duration_ = std::fmax(0.3, std::fabs(to_ - from_) / kMeanRate);
  }

  void step(double dt) {
    rate = 0;
    if (elapsed_ >= duration_) return;
    elapsed_ = std::fmin(elapsed_ + dt, duration_);
    const double t = elapsed_ / duration_;
    value = from_ + (to_ - from_) * (t - std::sin(2 * M_PI * t) / (2 * M_PI));
    rate = (to_ - from_) / duration_ * (1 - std::cos(2 * M_PI * t));
  }

  // Continues from its present value.
  void turn(double degrees_per_second, double dt) {
    value += degrees_per_second * dt;
    from_ = to_ += degrees_per_second * dt;
    rate += degrees_per_second;
  }

  bool moving() const { return elapsed_ < duration_; }

  double value = 0;  // degrees
  double rate = 0;   // degrees per second

 private:
  static constexpr double kMeanRate = 90;
  double from_ = 0, to_ = 0, elapsed_ = 0, duration_ = 0;
};

struct Attitude {
  SmoothAngle yaw, pitch, roll;
  double gyro_bias[3] = {0, 0, 0};   // degrees per second, the board's axes
  double accel_bias[3] = {0, 0, 0};  // g, the board's axes
  double temperature = 32.0;         // degrees Celsius
};

// The registers that a driver without the motion processor uses. Readings are those of the moment
// they are read; the low-pass filter and the sample clock are not modelled.
class Mpu6050 : public I2cRegisters {
 public:
  explicit Mpu6050(const Attitude& attitude) : attitude_(attitude) { power_on(); }

  bool start(bool read) override {
    if (failures > 0) {
      --failures;
      return false;
    }
    return I2cRegisters::start(read);
  }

  double id = 0x68;     // WHO_AM_I
  double failures = 0;  // the number of the next transfers that get no answer

 protected:
  void defaults() override {
    registers_[0x6B] = 0x40;  // asleep
  }

  void before_read(uint8_t pointer) override {
    registers_[0x75] = uint8_t(id);
    if (pointer < 0x3B || pointer > 0x48 || (registers_[0x6B] & 0x40)) return;
    const double roll = attitude_.roll.value * kDegree;
    const double pitch = attitude_.pitch.value * kDegree;
    const double up[3] = {-std::sin(pitch), std::sin(roll) * std::cos(pitch), std::cos(roll) * std::cos(pitch)};
    const double rate[3] = {
        attitude_.roll.rate - std::sin(pitch) * attitude_.yaw.rate,
        std::cos(roll) * attitude_.pitch.rate + std::sin(roll) * std::cos(pitch) * attitude_.yaw.rate,
        -std::sin(roll) * attitude_.pitch.rate + std::cos(roll) * std::cos(pitch) * attitude_.yaw.rate};
    const double lsb_per_g = 16384 >> (registers_[0x1C] >> 3 & 3);
    const double lsb_per_degree = 131.072 / (1 << (registers_[0x1B] >> 3 & 3));
    // How the board is mounted: ROS x is its y, ROS y its -x.
    const double board_up[3] = {-up[1], up[0], up[2]};
    const double board_rate[3] = {-rate[1], rate[0], rate[2]};
    for (uint8_t i = 0; i < 3; ++i) {
      put(0x3B + 2 * i, (board_up[i] + attitude_.accel_bias[i]) * lsb_per_g);
      put(0x43 + 2 * i, (board_rate[i] + attitude_.gyro_bias[i]) * lsb_per_degree);
    }
    put(0x41, (attitude_.temperature - 36.53) * 340);
  }

 private:
  void put(uint8_t reg, double value) {
    put_uint16_be(reg, uint16_t(int16_t(std::lround(std::fmax(-32768, std::fmin(32767, value))))));
  }

  const Attitude& attitude_;
};

class CarWorld : public World {
 public:
  CarWorld(Mcu& mcu, bool still) : mcu_(mcu), pins_(mcu, values), still_(still), mpu_(attitude_) {
    values.clock = [this] { return mcu_.seconds(); };
    mcu.attach_i2c(0x68, &mpu_);
    mcu.adc_volts = [this](int channel) { return volts(channel); };
    mcu.every(uint64_t(kStep * mcu.frequency()), [this] { step(); });
    mcu.after_reset = [this] { record_outputs(); };
    mcu.drive_pin('D', 2, encoder_level_);

    const auto changed = [this] { record_outputs(); };
    for (uint16_t address : {kOcr2a, kOcr2b, kTccr2a, kOcr1al, kTccr1b}) mcu.on_write(address, changed);
    for (int bit : {3, 5, 6, 7}) mcu.on_output_pin('D', bit, [this](bool) { record_outputs(); });
    for (int bit : {0, 3, 4, 5}) mcu.on_output_pin('B', bit, [this](bool) { record_outputs(); });
    record_outputs();

    add_angle("yaw", attitude_.yaw);
    add_angle("pitch", attitude_.pitch);
    add_angle("roll", attitude_.roll);
    values.reading("turning", [this] {
      return attitude_.yaw.moving() || attitude_.pitch.moving() || attitude_.roll.moving();
    });
    const char axes[] = "xyz";
    for (int i = 0; i < 3; ++i) {
      values.variable(std::string("gyro_bias_") + axes[i], &attitude_.gyro_bias[i]);
      values.variable(std::string("accel_bias_") + axes[i], &attitude_.accel_bias[i]);
    }
    values.variable("imu_temperature", &attitude_.temperature);
    values.variable("imu_present", [this] { return mpu_.present; },
                    [this](double present) { mpu_.set_present(present); });
    values.variable("imu_id", &mpu_.id);
    values.variable("imu_failures", &mpu_.failures);
    values.variable("battery", &battery_);
    values.variable("force", &force_);
    values.variable("steering_feedback", [this] { return steering_feedback(); },
                    [this](double raw) { forced_feedback_ = raw; });
    values.reading("wheel_turns", [this] { return wheel_turns_; });
    values.reading("wheel_speed", [this] { return wheel_speed_; });
    values.reading("wheel_ticks", [this] { return double(wheel_ticks_); });
  }

 private:
  static constexpr double kTicksPerTurn = 64;
  static constexpr double kFullSpeed = 15;     // turns per second at full PWM
  static constexpr double kMotorLag = 0.2;     // seconds
  static constexpr double kServoRate = 2000;   // microseconds of pulse per second
  static constexpr double kWheelPerimeter = 0.2, kWheelbase = 0.26;  // metres
  static constexpr double kMaxSteering = 25;   // degrees
  static constexpr double kDivider = 4;        // of the battery's voltage

  void add_angle(const std::string& name, SmoothAngle& angle) {
    values.variable(name, [&angle] { return angle.value; }, [&angle](double degrees) { angle.set(degrees); });
  }

  void record_outputs() {
    const bool pwm_on = mcu_.data(kTccr2a) & 0x20;
    const bool pwm_high = (!pwm_on || mcu_.input_pin('D', 3)) && pins_.level('D', 3);
    const bool forward = pins_.level('D', 7);
    const bool backward = pins_.level('B', 0);
    motor_pwm_ = pwm_high ? 255 : pwm_on ? mcu_.data(kOcr2b) : 0;
    motor_direction_ = int(forward) - int(backward);
    const unsigned top = mcu_.data(kIcr1h) << 8 | mcu_.data(kIcr1l);
    const unsigned match = mcu_.data(kOcr1ah) << 8 | mcu_.data(kOcr1al);
    // Fast PWM with the clock divided by eight: half microseconds, and one more than the match.
    const bool servo_on = top > 0 && (mcu_.data(kTccr1b) & 7) == 2;
    servo_us_ = servo_on ? (match + 1) / 2.0 : 0;
    // The core's analogWrite() switches the pin itself for 0 and 255.
    values.record("gripper_pwm", mcu_.data(kTccr2a) & 0x80 ? mcu_.data(kOcr2a) : 255 * pins_.level('B', 3));
    values.record("motor_pwm", motor_pwm_);
    values.record("motor_direction", motor_direction_);
    values.record("bridge_inputs", int(forward) + 2 * int(backward));
    values.record("servo_us", servo_us_);
    values.record("led_left", mcu_.output_pin('D', 5));
    values.record("led_right", mcu_.output_pin('D', 6));
    values.record("led_brake", mcu_.output_pin('B', 4));
    values.record("led_builtin", mcu_.output_pin('B', 5));
  }

  double steering_feedback() const {
    return forced_feedback_ >= 0 ? forced_feedback_ : 512 + (servo_position_ - 1500) * 0.6;
  }

  double volts(int channel) const {
    if (channel == 0) return (steering_feedback() + 0.5) * 5 / 1024;
    if (channel == 1) return battery_ / kDivider;
    if (channel == 6) return (force_ + 0.5) * 5 / 1024;
    return 0;
  }

  void step() {
    if (pins_.step()) record_outputs();
    const double wanted = kFullSpeed * motor_pwm_ / 255.0 * motor_direction_;
    wheel_speed_ += (wanted - wheel_speed_) * kStep / kMotorLag;
    if (motor_pwm_ == 0 && std::fabs(wheel_speed_) < 0.02) wheel_speed_ = 0;
    wheel_turns_ += wheel_speed_ * kStep;
    const bool level = std::floor(wheel_turns_ * kTicksPerTurn * 2) - 2 * std::floor(wheel_turns_ * kTicksPerTurn);
    if (level != encoder_level_) {
      encoder_level_ = level;
      if (level) ++wheel_ticks_;
      mcu_.drive_pin('D', 2, level);
    }

    const double travel = kServoRate * kStep;
    if (servo_us_ > 0) servo_position_ += std::fmax(-travel, std::fmin(travel, servo_us_ - servo_position_));

    attitude_.yaw.step(kStep);
    attitude_.pitch.step(kStep);
    attitude_.roll.step(kStep);
    if (still_) return;
    // A longer pulse steers to the right.
    const double steering = (1500 - servo_position_) / 500 * kMaxSteering * kDegree;
    attitude_.yaw.turn(wheel_speed_ * kWheelPerimeter * std::tan(steering) / kWheelbase / kDegree, kStep);
    battery_ -= (2e-5 + 2e-4 * motor_pwm_ / 255) * kStep;
  }

  Mcu& mcu_;
  OutputPins pins_;
  bool still_;
  Attitude attitude_;
  Mpu6050 mpu_;
  double battery_ = 14.8;
  double force_ = 100;           // raw ADC, of the example of custom messages
  double forced_feedback_ = -1;  // below 0: the servo's own position
  double servo_position_ = 1500;
  double servo_us_ = 0;
  int motor_pwm_ = 0;
  int motor_direction_ = 0;
  double wheel_speed_ = 0;
  double wheel_turns_ = 0;
  uint64_t wheel_ticks_ = 0;
  bool encoder_level_ = false;
};

}  // namespace

std::unique_ptr<World> make_car_world(Mcu& mcu, bool still) {
  return std::unique_ptr<World>(new CarWorld(mcu, still));
}
