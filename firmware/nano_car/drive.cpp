// See drive.h.

#include "drive.h"

#include <avr/interrupt.h>
#include <util/atomic.h>

#include "board.h"

namespace {

// Timer1 counts 0.5 us from 0 to TOP: 20 ms, the period of the servo and of two beats.
const uint16_t kTimer1Top = 39999;
const uint16_t kTimer1Half = 20000;

// Timer0 interrupts every 1.024 ms. The first tick may come right after a heartbeat; the motor stops at
// the tick after these, so never before the timeout.
const uint8_t kHeartbeatTimeoutTicks = kHeartbeatTimeoutMs * 1000UL / 1024 + 1;

volatile uint8_t ticks_since_heartbeat = kHeartbeatTimeoutTicks;
volatile bool motor_on = false;
volatile bool heartbeat_lost = false;

volatile uint8_t encoder_ticks = 0;
volatile uint8_t ticks_of_beats = 0;
volatile uint8_t beats = 0;

void motor_off() {
  OCR2B = 0;  // phase correct PWM holds the pin low at 0
  digitalWrite(kMotorForwardPin, LOW);
  digitalWrite(kMotorBackwardPin, LOW);
  motor_on = false;
}

void beat() {
  // More than one beat's ticks only when loop() was late: none is lost, and 255 is the packet's limit.
  const uint8_t room = 255 - ticks_of_beats;
  ticks_of_beats += encoder_ticks < room ? encoder_ticks : room;
  encoder_ticks = 0;
  ++beats;
}

}  // namespace

ISR(TIMER0_COMPA_vect) {
  if (ticks_since_heartbeat < kHeartbeatTimeoutTicks) {
    ++ticks_since_heartbeat;
  } else if (motor_on) {
    motor_off();
    heartbeat_lost = true;
  }
}

ISR(TIMER1_OVF_vect) { beat(); }
ISR(TIMER1_COMPB_vect) { beat(); }

ISR(INT0_vect) {
  if (encoder_ticks < 255) ++encoder_ticks;
}

void drive_begin() {
  pinMode(kMotorPwmPin, OUTPUT);
  pinMode(kMotorForwardPin, OUTPUT);
  pinMode(kMotorBackwardPin, OUTPUT);
  pinMode(kServoPin, OUTPUT);
  pinMode(kEncoderPin, INPUT_PULLUP);

  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    // Timer2: phase correct PWM at 490 Hz on OC2B, as the Arduino core sets it up.
    OCR2B = 0;
    TCCR2A = _BV(COM2B1) | _BV(WGM20);
    TCCR2B = _BV(CS22);
    // Timer1: fast PWM up to ICR1, clock / 8, the servo's pulse on OC1A. The clock starts last:
    // ICR1 can be written only in a mode that uses it, and shall not be 0 when the timer runs.
    TCCR1B = _BV(WGM13) | _BV(WGM12);
    TCCR1A = _BV(COM1A1) | _BV(WGM11);
    ICR1 = kTimer1Top;
    OCR1B = kTimer1Half;
    OCR1A = kServoCentreUs * 2 - 1;
    TCCR1B |= _BV(CS11);
    TIMSK1 = _BV(TOIE1) | _BV(OCIE1B);
    // Timer0 belongs to millis(); its compare interrupt comes at the same rate.
    TIMSK0 |= _BV(OCIE0A);
    // INT0: rising edge.
    EICRA = _BV(ISC01) | _BV(ISC00);
    EIMSK = _BV(INT0);
  }
}

void drive_heartbeat() { ticks_since_heartbeat = 0; }

void drive_set_speed(int16_t speed) {
  const uint16_t size = speed < 0 ? -speed : speed;
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    if (speed == 0 || ticks_since_heartbeat >= kHeartbeatTimeoutTicks) {
      motor_off();
    } else {
      digitalWrite(kMotorForwardPin, speed > 0);
      digitalWrite(kMotorBackwardPin, speed < 0);
      OCR2B = (size * 51 + 100) / 200;  // 0 … 1000 to 0 … 255, rounded
      motor_on = true;
    }
  }
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
    *ticks = ticks_of_beats;
    ticks_of_beats = 0;
    return count;
  }
  return 0;
}
