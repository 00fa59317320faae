// One stepper at a time on step and direction pins, with a ramp, driven by Timer2.

#ifndef CTRL_BOARD_STEPPER_H
#define CTRL_BOARD_STEPPER_H

#include <stdint.h>

struct StepperAxis {
  uint8_t step_pin;
  uint8_t direction_pin;
  uint16_t steps_per_second;
};

// An end switch that stops a move: a pin that goes low; 0 for none.
typedef uint8_t EndSwitchPin;

void stepper_begin();

// Starts a move; none may be running. `steps` is above 0.
void stepper_start(const StepperAxis& axis, bool positive, uint32_t steps, EndSwitchPin end_switch);

bool stepper_running();

// Steps that the last move was short of when its end switch stopped it.
uint32_t stepper_steps_missed();

#endif
