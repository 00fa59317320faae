// One stepper at a time on step and direction pins, with a ramp, driven by Timer2.

#ifndef CTRL_BOARD_STEPPER_H
#define CTRL_BOARD_STEPPER_H

#include <stdint.h>

// A position in steps that is kept through a reset: put a variable of this type into the section ".noinit". There are
// two copies, so that one is valid even if the reset comes while the other is written.
class StepCount {
 public:
  int16_t steps() const { return copies_[0].steps; }

  // To be called after a reset: starts at 0 if the RAM has no valid count, which is at power-up.
  void begin() { set(copies_[0].valid() ? copies_[0].steps : copies_[1].valid() ? copies_[1].steps : 0); }

  void set(int16_t value) {
    copies_[0].set(value);
    copies_[1].set(value);
  }

 private:
  struct Copy {
    volatile int16_t steps;
    volatile int16_t complement;

    bool valid() const { return complement == ~steps; }
    void set(int16_t value) {
      steps = value;
      complement = ~value;
    }
  };

  Copy copies_[2];
};

struct StepperAxis {
  uint8_t step_pin;
  uint8_t direction_pin;
  uint16_t steps_per_second;
  StepCount* count;  // 0: no counter
};

// An end switch that stops a move: a pin that goes high; 0 for none. It counts as open when it is high in two samples
// 1 ms apart, so that a spike from the motor's wires does not stop the lift.
typedef uint8_t EndSwitchPin;

// Whether it is open now; takes up to 1 ms.
bool stepper_switch_open(EndSwitchPin pin);

void stepper_begin();

// Starts a move; none may be running. `steps` is above 0.
void stepper_start(const StepperAxis& axis, bool positive, uint32_t steps, EndSwitchPin end_switch);

// Ends the present move at once.
void stepper_stop();

bool stepper_running();

// The steps that were left when the last move was stopped.
uint32_t stepper_steps_missed();

#endif
