// Motor, servo, encoder and the 100 Hz beat: everything that Timer0, Timer1, Timer2 and INT0 do.
//
// The motor stops in a timer interrupt when heartbeats stop: neither a sensor that hangs nor a long text can
// keep it on. Should the program itself hang, interrupts and all, the watchdog resets the chip 0.12 s later,
// and the pull-downs at the motor's pins stop the motor.

#ifndef NANO_CAR_DRIVE_H
#define NANO_CAR_DRIVE_H

#include <PacketLink.h>

// The heartbeats that this link receives keep the motor on.
void drive_begin(PacketLink& link);

// -1000 … 1000. Does nothing while no heartbeats arrive. Before the motor turns the other way it is off for
// two to three milliseconds.
void drive_set_speed(int16_t speed);

// Microseconds, limited to what the servo takes.
void drive_set_steering(uint16_t pulse_us);

// True once after heartbeats stopped a running motor.
bool drive_take_heartbeat_lost();

// The number of 10 ms beats since the last call (0: none yet) and the encoder ticks counted in them. A call
// that finds one keeps the watchdog quiet, which waits 0.12 s.
uint8_t drive_take_beats(uint8_t* ticks);

#endif
