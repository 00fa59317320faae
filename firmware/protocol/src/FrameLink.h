// A sensor board's link to the bridge (`mcu`): sends frames, and receives nothing.
//
// The port belongs to it: what Serial.print sends there is counted as errors. Print to another port.
//
//   FrameLink bridge(Serial);
//   bridge.send(0x20, value);      // a packed struct
//   bridge.update();               // in loop(), often, where the board announces its rows
//
// See examples/Sensor.

#ifndef FRAMELINK_H
#define FRAMELINK_H

#include "announcer.h"
#include "stream_sink.h"
#include "stx_etx.h"

namespace serial_communication {

// Each function returns whether the whole frame was sent.
class FrameLink : public StxEtxSender<StreamSink> {
 public:
  explicit FrameLink(Stream& port) : StxEtxSender<StreamSink>(StreamSink{&port}), port_(port) {}

  // Announces rows to the bridge, in update(): see announcer.h. `text` is an array in program memory (PROGMEM).
  template <size_t Size>
  void announce(const char (&text)[Size]) {
    announcer_.begin(text);
  }

  void update() {
    uint8_t chunk[Chunks::kMaxChunk];
    const uint8_t size = announcer_.next(port_, millis(), chunk);
    if (size > 0) StxEtxSender<StreamSink>::send(kTypeAnnouncement, chunk, size);
  }

 private:
  typedef Announcer<kMaxPayload - 4> Chunks;

  Stream& port_;
  Chunks announcer_;
};

}  // namespace serial_communication

using namespace serial_communication;

#endif
