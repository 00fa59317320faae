// A sketch with a header that `header` made.
#include <Arduino.h>
#include <PacketLink.h>

#define FIRMWARE_NAME "my_robot"
#define FIRMWARE_VERSION "1.0"
#include "my_robot.h"

PacketLink bridge(Serial);

void handle_gripper(const Gripper& gripper) {
  Force force;
  force.data = gripper.x;
  bridge.send(Force::TYPE, force);
  const LineSensors<2> line = {{uint16_t(gripper.x), gripper.z}};
  bridge.send(line.TYPE, line);
  const MagneticField field = {1, -1, gripper.x, 258};
  bridge.send(field.TYPE, field);
}

void setup() {
  bridge.on<Gripper>(Gripper::TYPE, handle_gripper);
  bridge.announce(kAnnouncement);
}

void loop() { bridge.update(); }

#if defined(ON_THE_PC)
#include "stdio_board.h"
#endif
