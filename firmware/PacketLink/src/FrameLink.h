// A sensor board's link to the bridge (`mcu`): sends frames, and receives nothing but settings.
//
// The port belongs to it: what Serial.print sends there is counted as errors. Print to another port.
//
//   FrameLink bridge(Serial);
//   bridge.time(micros());         // when the next frame is measured: its stamp
//   bridge.send(0x20, value);      // a packed struct
//   bridge.update();               // in loop(), often, where the board announces its rows or has settings
//
// See examples/Sensor.

#ifndef FRAMELINK_H
#define FRAMELINK_H

#include "announcer.h"
#include "settings.h"
#include "stream_sink.h"
#include "stx_etx.h"

namespace serial_communication {

// Each function returns whether the whole frame was sent.
class FrameLink : public StxEtxSender<StreamSink> {
 public:
  explicit FrameLink(Stream& port) : StxEtxSender<StreamSink>(StreamSink{&port}), port_(port), buffer_(port) {}

  // Announces rows to the bridge, in update(): see announcer.h. `text` is an array in program memory (PROGMEM).
  template <size_t Size>
  void announce(const char (&text)[Size]) {
    announcer_.begin(text);
    if (!send_regularly_) send_regularly_ = &send_chunk;
  }

  // Lets the bridge change and show settings, in update(): see settings.h. `table` is an array in program memory.
  // `changed` is called with the number of one that has another value.
  template <size_t Count>
  void settings(const Setting (&table)[Count], void (*changed)(uint8_t number) = 0) {
    settings_.begin(table, changed);
    receiver_.begin();
    send_regularly_ = &exchange_settings;
  }

  void update() {
    if (send_regularly_) send_regularly_(*this);
  }

 private:
  static const uint8_t kFraming = 6;
  typedef Announcer<kMaxPayload - 4, kFraming> Chunks;

  // Returns whether one was due, also where nothing is announced.
  static bool send_chunk(FrameLink& link) {
    if (!link.announcer_.is_due(link.buffer_, millis())) return false;
    uint8_t chunk[Chunks::kMaxChunk];
    const uint8_t size = link.announcer_.next(chunk);
    if (size > 0) link.send_frame(kTypeAnnouncement, chunk, size);
    return true;
  }

  static bool exchange_settings(FrameLink& link) {
    for (uint8_t left = kMaxReadAtOnce; left > 0 && link.port_.available() > 0; --left) {
      uint8_t size;
      const uint8_t* received = link.receiver_.feed(static_cast<uint8_t>(link.port_.read()), &size);
      if (received) link.settings_.take(received, size);
    }
    const bool due = send_chunk(link);
    if (due) link.settings_.report_one();
    uint8_t setting[SettingsTable::kMaxData];
    const uint8_t room = SettingsTable::kMaxData + kFraming + (due ? 0 : SettingsTable::kLeftFree);
    const uint8_t size = link.settings_.next(link.buffer_, room, setting);
    if (size > 0) link.send_frame(kTypeSetting, setting, size);
    return due;
  }

  Stream& port_;
  SendBuffer buffer_;
  Chunks announcer_;
  SettingsTable settings_;
  SettingReceiver receiver_;
  bool (*send_regularly_)(FrameLink&) = 0;  // so that only a sketch that announces or has settings has the code
};

}  // namespace serial_communication

// Only these names need no serial_communication:: in a sketch; others, such as Packet, are free for its own.
using serial_communication::FrameLink;
using serial_communication::SensorStatus;
using serial_communication::kAngleUnknown;
using serial_communication::kRangeTimedOut;

#endif
