// See stepper.h.

#include "stepper.h"

#include <Arduino.h>
#include <avr/interrupt.h>
#include <util/atomic.h>

namespace {

// During a move Timer2 interrupts at this rate; when the phase overflows, a step is made.
const uint32_t kTickHz = 16000;
const uint8_t kTimer2Top = F_CPU / 8 / kTickHz - 1;

const uint8_t kSampleTicks = kTickHz / 1000;  // between two samples of the end switch

constexpr uint16_t phase_per_tick(uint16_t steps_per_second) {
  return uint16_t(uint32_t(steps_per_second) * 65536 / kTickHz);
}

// From rest a stepper starts at this rate; above it the rate rises by 1 a tick, which is 3900 steps/s².
const uint16_t kStartVelocity = phase_per_tick(300);

volatile uint8_t* step_port;
uint8_t step_mask;
volatile uint8_t* switch_port;
uint8_t switch_mask;
uint8_t sample_ticks;
bool was_open;  // the end switch, at the last sample
StepCount* step_count;
int8_t step_sign;

volatile uint32_t steps_left = 0;
volatile uint32_t steps_missed = 0;
uint32_t ramp_steps;  // made while accelerating: slowing down needs as many
uint16_t velocity;
uint16_t start_velocity;
uint16_t top_velocity;
uint16_t phase;

void stop() {
  TIMSK2 = 0;
  steps_missed += steps_left;  // a stop that follows the end switch does not hide what that one cut off
  steps_left = 0;
}

// Whether the end switch was open in the last two samples; to be called each tick.
bool at_end() {
  if (switch_mask == 0 || --sample_ticks > 0) return false;
  sample_ticks = kSampleTicks;
  const bool open = *switch_port & switch_mask;
  const bool both = open && was_open;
  was_open = open;
  return both;
}

}  // namespace

ISR(TIMER2_COMPA_vect) {
  *step_port &= ~step_mask;  // a step's pulse lasts one tick
  if (steps_left == 0 || at_end()) {
    stop();
    return;
  }
  const bool slowing = steps_left <= ramp_steps;
  if (slowing) {
    if (velocity > start_velocity) --velocity;
  } else if (velocity < top_velocity) {
    ++velocity;
  }
  const uint16_t before = phase;
  phase += velocity;
  if (phase < before) {
    *step_port |= step_mask;
    --steps_left;
    if (step_count) step_count->set(step_count->steps() + step_sign);
    if (!slowing && velocity < top_velocity) ++ramp_steps;
  }
}

void stepper_begin() {
  TCCR2A = _BV(WGM21);  // clear on compare
  TCCR2B = _BV(CS21);   // clock / 8
  OCR2A = kTimer2Top;
}

bool stepper_switch_open(EndSwitchPin pin) {
  if (digitalRead(pin) == LOW) return false;
  delay(1);
  return digitalRead(pin) == HIGH;
}

void stepper_start(const StepperAxis& axis, bool positive, uint32_t steps, EndSwitchPin end_switch) {
  digitalWrite(axis.direction_pin, positive);
  step_port = portOutputRegister(digitalPinToPort(axis.step_pin));
  step_mask = digitalPinToBitMask(axis.step_pin);
  switch_port = portInputRegister(digitalPinToPort(end_switch));
  switch_mask = end_switch == 0 ? 0 : digitalPinToBitMask(end_switch);
  sample_ticks = kSampleTicks;
  was_open = false;
  step_count = axis.count;
  step_sign = positive ? 1 : -1;
  ramp_steps = 0;
  phase = 0;
  top_velocity = phase_per_tick(axis.steps_per_second);
  velocity = start_velocity = min(kStartVelocity, top_velocity);
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    steps_missed = 0;
    steps_left = steps;
    TCNT2 = 0;
    TIFR2 = _BV(OCF2A);
    TIMSK2 = _BV(OCIE2A);
  }
}

void stepper_stop() {
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    *step_port &= ~step_mask;
    stop();
  }
}

bool stepper_running() { return TIMSK2 != 0; }

uint32_t stepper_steps_missed() {
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { return steps_missed; }
  return 0;
}
