// Sends through a port of the Arduino core: Serial, Serial1, SoftwareSerial …

#ifndef SERIAL_COMMUNICATION_STREAM_SINK_H
#define SERIAL_COMMUNICATION_STREAM_SINK_H

#include <Arduino.h>

namespace serial_communication {

struct StreamSink {
  Stream* port;

  bool operator()(const uint8_t* bytes, size_t size) const { return port->write(bytes, size) == size; }
};

}  // namespace serial_communication

#endif
