// See drive.h.

#include "drive.h"

#include <avr/interrupt.h>
#include <safe_board.h>
#include <util/atomic.h>

#include "board.h"

namespace {

// Timer1 counts 0.5 us from 0 to TOP: 20 ms, the period of the servo and of two beats.
const uint16_t kTimer1Top = 39999;
const uint16_t kTimer1Half = 20000;

const uint8_t kOutputs[] = {kMotorPwmPin, kMotorForwardPin, kMotorBackwardPin,
#ifdef CUSTOM_MESSAGES
                            kGripperPin
#endif
};

// Ticks of Timer0, 1.024 ms each. Both inputs of the bridge stay low for this time before the motor changes
// direction. Timer2 takes a new duty at the end of a period, 2.04 ms: until then the bridge may still be enabled.
const uint8_t kPauseTicks = 3;

// Shared with the timer's interrupt; used only with interrupts disabled.
int8_t direction = 0;         // of the bridge: 1, -1, or 0 with both inputs low
int8_t wanted_direction = 0;  // direction after the pause
uint8_t wanted_duty = 0;
uint16_t duty = 0;            // of now, 1/256
uint16_t ramp_step = 0xFFFF;  // by which it may rise in a tick, 1/256
uint8_t pause_ticks = 0;
bool heartbeat_lost = false;

volatile uint8_t encoder_ticks = 0;
volatile uint8_t ticks_of_beats = 0;
volatile uint8_t beats = 0;

void bridge_off() {
  OCR2B = duty = 0;  // phase correct PWM holds the pin low at 0
  digitalWrite(kMotorForwardPin, LOW);
  digitalWrite(kMotorBackwardPin, LOW);
  if (direction != 0) pause_ticks = kPauseTicks;
  direction = 0;
}

void motor_off() {
  wanted_direction = 0;
  bridge_off();
}

void stop() {
  if (wanted_direction == 0) return;
  motor_off();
  heartbeat_lost = true;
}

void set_duty(uint16_t most) {
  const uint16_t wanted = uint16_t(wanted_duty) << 8;
  duty = wanted < most ? wanted : most;
  OCR2B = duty >> 8;
}

// Sets the bridge as wanted; called again at the end of a pause.
void drive_motor() {
  if (direction != wanted_direction) bridge_off();
  if (pause_ticks > 0) return;
  direction = wanted_direction;
  digitalWrite(kMotorForwardPin, direction > 0);
  digitalWrite(kMotorBackwardPin, direction < 0);
  set_duty(duty);  // it falls at once, and rises at the next ticks
}

void beat() {
  // If loop() was late, this has the ticks of several beats: none is lost, up to the packet's limit of 255.
  const uint8_t room = 255 - ticks_of_beats;
  ticks_of_beats += encoder_ticks < room ? encoder_ticks : room;
  encoder_ticks = 0;
  ++beats;
}

}  // namespace

STOP_WITHOUT_HEARTBEATS(stop)

ISR(TIMER0_COMPB_vect) {
  if (pause_ticks > 0) {
    if (--pause_ticks == 0 && wanted_direction != 0) drive_motor();
  } else if (direction != 0) {
    set_duty(duty < 0xFFFF - ramp_step ? duty + ramp_step : 0xFFFF);
  }
}

ISR(TIMER1_OVF_vect) { beat(); }
ISR(TIMER1_COMPB_vect) { beat(); }

ISR(INT0_vect) {
  if (encoder_ticks < 255) ++encoder_ticks;
}

void drive_begin(PacketLink& link) {
  safe_begin(kOutputs, link, heartbeats);
  pinMode(kServoPin, OUTPUT);
  pinMode(kEncoderPin, INPUT_PULLUP);

  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    // Timer2: phase correct PWM at 490 Hz on OC2B, as the Arduino core sets it up.
    OCR2B = 0;
    TCCR2A = _BV(COM2B1) | _BV(WGM20);
    TCCR2B = _BV(CS22);
    // Timer1: fast PWM up to ICR1, clock / 8, the servo's pulse on OC1A. The clock starts last:
    // ICR1 can be written only in a mode that uses it, and must not be 0 when the timer runs.
    TCCR1B = _BV(WGM13) | _BV(WGM12);
    TCCR1A = _BV(COM1A1) | _BV(WGM11);
    ICR1 = kTimer1Top;
    OCR1B = kTimer1Half;
    OCR1A = kServoCentreUs * 2 - 1;
    TCCR1B |= _BV(CS11);
    TIMSK1 = _BV(TOIE1) | _BV(OCIE1B);
    // Timer0 belongs to millis(); both of its compare interrupts come at the same rate.
    TIMSK0 |= _BV(OCIE0B);
    // INT0: rising edge.
    EICRA = _BV(ISC01) | _BV(ISC00);
    EIMSK = _BV(INT0);
  }
}

void drive_set_speed(int16_t speed) {
  const uint16_t size = speed < 0 ? -speed : speed;
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    if (speed == 0 || !heartbeats.alive()) {
      motor_off();
    } else {
      wanted_direction = speed > 0 ? 1 : -1;
      wanted_duty = (size * 51 + 100) / 200;  // 0 … 1000 to 0 … 255, rounded
      drive_motor();
    }
  }
}

void drive_set_ramp(uint16_t milliseconds) {
  const uint16_t step = milliseconds < 2 ? 0xFFFF : 66846UL / milliseconds;  // 255 * 256 in ticks of 1.024 ms
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { ramp_step = step; }
}

void drive_set_steering(uint16_t pulse_us) {
  const uint16_t us = constrain(pulse_us, kServoMinUs, kServoMaxUs);
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { OCR1A = us * 2 - 1; }
}

bool drive_take_heartbeat_lost() {
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    const bool lost = heartbeat_lost;
    heartbeat_lost = false;
    return lost;
  }
  return false;
}

uint8_t drive_take_beats(uint8_t* ticks) {
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    const uint8_t count = beats;
    beats = 0;
    if (count > 0) safe_update();
    *ticks = ticks_of_beats;
    ticks_of_beats = 0;
    return count;
  }
  return 0;
}
