// A sensor board's link to the bridge (`mcu`): sends frames, and receives nothing.
//
//   FrameLink bridge(Serial);
//   bridge.send(0x20, value);      // a packed struct
//
// See examples/Sensor.

#ifndef FRAMELINK_H
#define FRAMELINK_H

#include "stream_sink.h"
#include "stx_etx.h"

namespace serial_communication {

// Each function returns whether the whole frame was sent.
class FrameLink : public StxEtxSender<StreamSink> {
 public:
  explicit FrameLink(Stream& port) : StxEtxSender<StreamSink>(StreamSink{&port}) {}
};

}  // namespace serial_communication

using namespace serial_communication;

#endif
