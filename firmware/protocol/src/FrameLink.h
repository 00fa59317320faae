// A sensor board's link to the bridge (`mcu`): sends frames, and receives nothing.
//
// The port belongs to it: what Serial.print sends there is counted as errors. Print to another port.
//
//   FrameLink bridge(Serial);
//   bridge.time(micros());         // when the next frame is measured: its stamp
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
  explicit FrameLink(Stream& port) : StxEtxSender<StreamSink>(StreamSink{&port}), buffer_(port) {}

  // Announces rows to the bridge, in update(): see announcer.h. `text` is an array in program memory (PROGMEM).
  template <size_t Size>
  void announce(const char (&text)[Size]) {
    announcer_.begin(text);
    send_chunk_ = &FrameLink::send_chunk;
  }

  void update() {
    if (send_chunk_) send_chunk_(*this);
  }

 private:
  typedef Announcer<kMaxPayload - 4, 6> Chunks;

  static void send_chunk(FrameLink& link) {
    uint8_t chunk[Chunks::kMaxChunk];
    const uint8_t size = link.announcer_.next(link.buffer_, millis(), chunk);
    if (size > 0) link.send_frame(kTypeAnnouncement, chunk, size);
  }

  SendBuffer buffer_;
  Chunks announcer_;
  void (*send_chunk_)(FrameLink&) = 0;  // so that only a sketch that announces has the code
};

}  // namespace serial_communication

// Only these names need no serial_communication:: in a sketch; others, such as Packet, are free for its own.
using serial_communication::FrameLink;
using serial_communication::SensorStatus;
using serial_communication::kAngleUnknown;
using serial_communication::kRangeTimedOut;

#endif
