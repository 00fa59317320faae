// Motor, servo, encoder and the 100 Hz beat: everything that Timer0, Timer1, Timer2 and INT0 do.
//
// The heartbeat stop runs in an interrupt: neither a hung sensor nor a long text can keep the motor on.

#ifndef NANO_CAR_DRIVE_H
#define NANO_CAR_DRIVE_H

#include <stdint.h>

void drive_begin();

// Call for each HEARTBEAT.
void drive_heartbeat();

// -1000 … 1000. Does nothing while no heartbeats come.
void drive_set_speed(int16_t speed);

// Microseconds, limited to what the servo takes.
void drive_set_steering(uint16_t pulse_us);

// True once after heartbeats stopped a running motor.
bool drive_take_heartbeat_lost();

// The number of 10 ms beats since the last call (0: none yet) and the encoder ticks counted in them.
uint8_t drive_take_beats(uint8_t* ticks);

#endif
