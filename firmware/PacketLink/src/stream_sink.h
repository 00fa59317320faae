// Sends through a port of the Arduino core: Serial, Serial1, SoftwareSerial …

#ifndef SERIAL_COMMUNICATION_STREAM_SINK_H
#define SERIAL_COMMUNICATION_STREAM_SINK_H

#include <Arduino.h>

namespace serial_communication {

const uint8_t kMaxReadAtOnce = 64;  // bytes that update() takes in one call, so that loop() goes on whatever comes in

struct StreamSink {
  Stream* port;

  bool operator()(const uint8_t* bytes, size_t size) const { return port->write(bytes, size) == size; }
};

// The send buffer of a port: whether a write would wait for room in it.
class SendBuffer {
 public:
  explicit SendBuffer(Stream& port) : port_(port) {}

  // Of a port that does not know its room the answer is yes.
  bool has_room(uint8_t size) {
    const int room = this->room();
    return room >= size || room == most_room_;
  }
  bool is_empty() { return room() == most_room_; }

 private:
  int room() {
    const int room = port_.availableForWrite();
    if (room > most_room_) most_room_ = room;
    return room;
  }

  Stream& port_;
  int most_room_ = 0;  // the buffer is empty then
};

}  // namespace serial_communication

#endif
