// Motor, servo, encoder and the 100 Hz clock: all uses of Timer0, Timer1, Timer2 and INT0.
//
// A timer interrupt stops the motor when heartbeats stop, so neither a blocked sensor nor a long text can
// keep it on. If the program hangs with interrupts disabled, the watchdog resets the chip after 0.12 s,
// and the pull-downs at the motor's pins stop the motor.

#ifndef NANO_CAR_DRIVE_H
#define NANO_CAR_DRIVE_H

#include <PacketLink.h>

// The heartbeats that this link receives keep the motor on.
void drive_begin(PacketLink& link);

// -1000 … 1000. Does nothing while no heartbeats arrive. Before it changes direction, the motor is off for
// two to three milliseconds.
void drive_set_speed(int16_t speed);

// The time in which the motor's speed rises from 0 to 1000; 0: at once. It falls at once, whatever this is.
void drive_set_ramp(uint16_t milliseconds);

// Microseconds, limited to the range of the servo.
void drive_set_steering(uint16_t pulse_us);

// True once after heartbeats stopped a running motor.
bool drive_take_heartbeat_lost();

// The number of 10 ms beats since the last call (0: none yet) and the encoder ticks counted in them. A call
// that returns one resets the watchdog, whose timeout is 0.12 s.
uint8_t drive_take_beats(uint8_t* ticks);

#endif
