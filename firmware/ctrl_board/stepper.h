// One stepper at a time on step and direction pins, with a ramp, driven by Timer2.

#ifndef CTRL_BOARD_STEPPER_H
#define CTRL_BOARD_STEPPER_H

#include <stdint.h>

// A position in steps that is kept through a reset: put a variable of this type into the section ".noinit".
struct StepCount {
  int16_t steps;
  int16_t complement;

  // To be called after a reset: starts at 0 if the RAM has no valid count, which is at power-up.
  void begin() {
    if (complement != ~steps) set(0);
  }
  void set(int16_t value) {
    steps = value;
    complement = ~value;
  }
};

struct StepperAxis {
  uint8_t step_pin;
  uint8_t direction_pin;
  uint16_t steps_per_second;
  StepCount* count;  // 0: no counter
};

// An end switch that stops a move: a pin that goes high; 0 for none.
typedef uint8_t EndSwitchPin;

void stepper_begin();

// Starts a move; none may be running. `steps` is above 0.
void stepper_start(const StepperAxis& axis, bool positive, uint32_t steps, EndSwitchPin end_switch);

// Ends the present move at once.
void stepper_stop();

bool stepper_running();

// The steps that were left when the last move was stopped.
uint32_t stepper_steps_missed();

#endif
