// Makes a board safe by itself, whatever its program does. A sketch uses it in three lines:
//
//   STOP_WITHOUT_HEARTBEATS(motor_off)             // a car: AVR, PacketLink; defines `heartbeats`
//   safe_begin(kOutputs, bridge, heartbeats);      // first in setup(); other boards: safe_begin(kOutputs)
//   safe_update();                                 // in loop(), at least every 0.1 s
//
// - Safe pins: kOutputs (const uint8_t []) are the pins that turn on motors, doors and pumps. They are low outputs
//   from the start. Before this, and in the bootloader, they float: each needs 10 kOhm to ground.
// - Heartbeats: 30 ms after the last one has arrived, a timer interrupt calls motor_off(), every 1.024 ms and even if
//   loop() is delayed. A function that turns the motor on does this only `if (heartbeats.alive())`, with interrupts
//   disabled.
// - Watchdog: a program that hangs is reset, on an AVR after 0.12 s, even if it hangs with interrupts disabled. Then
//   all pins float, which turns everything off. On an ESP32 it is the task watchdog of loop(), after 5 s.
//
// With the old bootloader of the Nano (ATmegaBOOT, 57600 baud) a reset by the watchdog never ends: the pins float
// until the power is switched off and on. Optiboot starts the program again at once.
//
// Include it in one file of a sketch only.

#ifndef SERIAL_COMMUNICATION_SAFE_BOARD_H
#define SERIAL_COMMUNICATION_SAFE_BOARD_H

#include <Arduino.h>

#if defined(__AVR__)
#include <avr/wdt.h>

#include "heartbeat_watch.h"

// After a reset by the watchdog it is still enabled, with 16 ms. So it is disabled before the variables are set up.
static void safe_board_watchdog_off() __attribute__((naked, used, section(".init3")));
static void safe_board_watchdog_off() {
  MCUSR = 0;
  wdt_disable();
}

#define STOP_WITHOUT_HEARTBEATS(stop)                          \
  static serial_communication::HeartbeatWatch heartbeats;      \
  ISR(TIMER0_COMPA_vect) {                                     \
    heartbeats.tick(static_cast<uint8_t>(Serial.available())); \
    if (!heartbeats.alive()) stop();                           \
  }
#endif

namespace serial_communication {

inline void safe_update() {
#if defined(__AVR__)
  wdt_reset();
#elif defined(ARDUINO_ARCH_ESP32)
  feedLoopWDT();
#endif
}

// For a board without motors, doors and pumps.
inline void safe_begin() {
#if defined(__AVR__)
  wdt_enable(WDTO_120MS);
#elif defined(ARDUINO_ARCH_ESP32)
  enableLoopWDT();
#endif
}

template <size_t Count>
void safe_begin(const uint8_t (&outputs)[Count]) {
  for (uint8_t pin : outputs) {
    digitalWrite(pin, LOW);  // before the pin is an output: it must not drive high
    pinMode(pin, OUTPUT);
  }
  safe_begin();
}

#if defined(__AVR__)
// `link`: the PacketLink whose heartbeats keep the motor on.
template <size_t Count, class Link>
void safe_begin(const uint8_t (&outputs)[Count], Link& link, HeartbeatWatch& heartbeats) {
  link.watch(heartbeats);
  safe_begin(outputs);
  TIMSK0 |= _BV(OCIE0A);  // Timer0 counts millis(); its compare interrupt comes at the same rate
}
#endif

}  // namespace serial_communication

using serial_communication::safe_begin;
using serial_communication::safe_update;

#endif
