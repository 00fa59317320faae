// A world with nothing in it: clients drive the pins of a Nano and read them, for a sketch of one's own.
//
// dN     the level at a pin, 0 or 1; set to 0 or 1 it is driven from outside, set to -1 it is released
// aN     what an analogue pin has, 0 … 1023
// pwmN   the duty of analogWrite(), 0 … 255, on the pins that have it

#include <cmath>
#include <string>

#include "world.h"

namespace {

const int kDigitalPins = 20;  // 14 … 19 are A0 … A5
const int kAnaloguePins = 8;

struct Pin {
  char port;
  int bit;
};

Pin digital(int number) {
  return number < 8 ? Pin{'D', number} : number < 14 ? Pin{'B', number - 8} : Pin{'C', number - 14};
}

// Where a timer's compare unit drives a pin: the register and bit that connect it, and its duty.
struct Pwm {
  int pin;
  uint16_t control;
  uint8_t connected;
  uint16_t duty;
};
const Pwm kPwms[] = {{3, 0xB0, 0x20, 0xB4}, {5, 0x44, 0x20, 0x48}, {6, 0x44, 0x80, 0x47},
                     {9, 0x80, 0x80, 0x88}, {10, 0x80, 0x20, 0x8A}, {11, 0xB0, 0x80, 0xB3}};

class PinsWorld : public World {
 public:
  explicit PinsWorld(Mcu& mcu) : mcu_(mcu) {
    values.clock = [this] { return mcu_.seconds(); };
    for (int number = 0; number < kDigitalPins; ++number) {
      const Pin pin = digital(number);
      values.variable("d" + std::to_string(number), [this, pin] { return double(mcu_.pin_level(pin.port, pin.bit)); },
                      [this, pin](double level) { drive(pin, level); });
    }
    for (int channel = 0; channel < kAnaloguePins; ++channel) {
      values.variable("a" + std::to_string(channel), &analogue_[channel]);
    }
    for (const Pwm& pwm : kPwms) values.reading("pwm" + std::to_string(pwm.pin), [this, &pwm] { return duty(pwm); });
    mcu_.adc_volts = [this](int channel) { return (std::round(analogue_[channel]) + 0.5) / 1024 * 5; };
  }

 private:
  void drive(const Pin& pin, double level) {
    if (level < 0) {
      mcu_.release_pin(pin.port, pin.bit);
    } else {
      mcu_.drive_pin(pin.port, pin.bit, level != 0);
    }
  }

  // The core's analogWrite() switches the pin itself for 0 and 255.
  double duty(const Pwm& pwm) const {
    const Pin pin = digital(pwm.pin);
    if (mcu_.data(pwm.control) & pwm.connected) return mcu_.data(pwm.duty);
    return 255.0 * mcu_.output_pin(pin.port, pin.bit);
  }

  Mcu& mcu_;
  double analogue_[kAnaloguePins] = {};
};

}  // namespace

std::unique_ptr<World> make_pins_world(Mcu& mcu) { return std::unique_ptr<World>(new PinsWorld(mcu)); }
