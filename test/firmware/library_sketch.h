// A sketch with all three links, whose statement WRONG must not compile: the tests put each mistake there.

#include <Arduino.h>
#include <BusSlave.h>
#include <FrameLink.h>
#include <PacketLink.h>
#include <rate_limit.h>

#ifndef WRONG
#define WRONG
#endif

struct PACKED Force { int16_t centinewtons; };
struct PACKED Big { uint8_t a[64]; };
struct Wide { uint8_t a; uint32_t b; };
PacketLink packets(Serial);
FrameLink frames(Serial);
BusSlave bus(Serial);
int taken = 0;
void take_force(const Force& force) { taken = force.centinewtons; }
void take_big(const Big&) {}
void take_wide(const Wide&) {}
BusResult ask_force(const Force& force) { return BusResult::ok(force); }
BusResult ask_wide(const Wide&) { return BusResult::ok(); }
bool all() {
  const Force force = {1};
  WRONG
  return packets.send(32, force) && frames.send(32, force) && packets.on<Force>(48, take_force) &&
         bus.on<Force>(48, ask_force);
}
