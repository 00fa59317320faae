// Sketches with the library's links, on the PC under sanitizers; their port and their clock are a script's.
//
//   pc_board packets|frames|bus [OPTION …] < SCRIPT
//
// SCRIPT has words: HEX: these bytes arrive; +N: N ms pass, in each of which loop() runs once; !: what is pending ends.
// A line is printed for each write, `MS sent HEX`, and for each function that is called, `MS NAME VALUES`.
// OPTIONs: rows, settings: they are announced; busy: the sketch sends as much as one of the reference sketches.

#include <BusSlave.h>
#include <FrameLink.h>
#include <PacketLink.h>
#include <stdio.h>
#include <stdlib.h>

#include <iostream>
#include <set>
#include <string>

using serial_communication::MessageType;
typedef std::string Bytes;

static unsigned long now_ms = 0;
unsigned long millis() { return now_ms; }

static Bytes from_hex(const std::string& text) {
  Bytes bytes;
  for (size_t at = 0; at + 1 < text.size(); at += 2) bytes += char(strtoul(text.substr(at, 2).c_str(), nullptr, 16));
  return bytes;
}

static std::string to_hex(const void* bytes, size_t size) {
  std::string text;
  char digits[3];
  for (size_t at = 0; at < size; ++at) {
    snprintf(digits, sizeof digits, "%02x", static_cast<const uint8_t*>(bytes)[at]);
    text += digits;
  }
  return text;
}

static void say(const char* what, const std::string& values) { printf("%lu %s %s\n", now_ms, what, values.c_str()); }

// With the send buffer of an AVR, at 115200 baud.
class Port : public Stream {
 public:
  Bytes received;

  int available() override { return int(received.size()); }
  int read() override {
    const uint8_t byte = uint8_t(received[0]);
    received.erase(0, 1);
    return byte;
  }
  int availableForWrite() override { return kRoom - waiting_; }
  size_t write(uint8_t byte) override { return write(&byte, 1); }
  size_t write(const uint8_t* bytes, size_t size) override {
    waiting_ += int(size);
    say(waiting_ > kRoom ? "waits and sent" : "sent", to_hex(bytes, size));
    return size;
  }
  void pass_ms() {
    tenths_ += 115;
    for (; tenths_ >= 10; tenths_ -= 10) waiting_ -= waiting_ > 0;
  }

 private:
  static const int kRoom = 63;
  int waiting_ = 0, tenths_ = 0;
} port;

struct PACKED Force {
  int16_t centinewtons;
};
#define SETTINGS(SETTING)                                                   \
  SETTING(1, gain, float, 0.5, 0, 10, "1/s", "a gain")                      \
  SETTING(2, period, uint16_t, 20, 5, 60000, "ms", "a period")              \
  SETTING(3, inverted, bool, 1, 0, 1, "", "whether it turns the other way") \
  SETTING(4, trim, int8_t, -5, -100, 100, "", "")                           \
  SETTING(5, position, int32_t, 0, -2147483647, 16777217, "", "")           \
  SETTING(200, mask, uint32_t, 7, 7, 4294967295, "", "")
SETTINGS(SETTING_VARIABLE)
static constexpr Setting settings[] = {SETTINGS(SETTING_ENTRY)};
static const char rows[] = "firmware: test 1.0\n" SETTINGS(SETTING_ROW);
static void changed(uint8_t number) { say("changed", std::to_string(number)); }

class Sketch {
 public:
  virtual ~Sketch() {}
  virtual void loop(bool busy) = 0;
};

class PacketSketch : public Sketch {
 public:
  explicit PacketSketch(const std::set<std::string>& options) : bridge_(port) {
    static PacketLink* link = &bridge_;
    bridge_.on<Force>(48, [](const Force& force) { say("force", std::to_string(force.centinewtons)); });
    bridge_.on(50, [](const uint8_t* data, size_t size) { say("bytes", to_hex(data, size)); });
    // Sends a packet: the type is the first of these bytes.
    bridge_.on(52, [](const uint8_t* data, size_t size) { link->send(MessageType(data[0]), data + 1, size - 1); });
    bridge_.on_speed([](int16_t speed) { say("speed", std::to_string(speed)); });
    bridge_.on_steering([](uint16_t pulse) { say("steering", std::to_string(pulse)); });
    bridge_.on_led([](const char* text) { say("led", to_hex(text, strlen(text))); });
    bridge_.on_calibration([]() { say("calibration", ""); });
    if (options.count("rows")) bridge_.announce(rows);
    if (options.count("settings")) bridge_.settings(settings, changed);
  }
  void loop(bool busy) override {
    bridge_.update();
    if (!busy || now_ms % 10 != 0) return;
    for (int i = 0; i < 8; ++i) bridge_.send_ticks(0);  // 39 bytes, as many as the car sends
    bridge_.send_voltage(12);
  }

 private:
  PacketLink bridge_;
};

class FrameSketch : public Sketch {
 public:
  explicit FrameSketch(const std::set<std::string>& options) : bridge_(port) {
    if (options.count("rows")) bridge_.announce(rows);
    if (options.count("settings")) bridge_.settings(settings, changed);
  }
  void loop(bool busy) override {
    bridge_.update();
    const uint16_t channels[6] = {1, 2, 300, 4, 5, 1023};
    if (busy && now_ms % 50 == 0) bridge_.send_adc_status(channels);
  }

 private:
  FrameLink bridge_;
};

static bool pending = false;

class BusSketch : public Sketch {
 public:
  BusSketch() : bus_(port) {
    bus_.on<Force>(48, [](const Force& force) { return called("force", &force, 2), BusResult::ok(force); });
    bus_.on(49, []() { return called("move", "", 0), pending = true, BusResult::pending(); });
    bus_.on(51, [](const uint8_t* data, size_t size) { return called("bytes", data, size), BusResult::ok(); });
    bus_.on_pending([]() { return pending ? BusResult::pending() : BusResult::ok(); });
    bus_.on_stop([]() { called("stop", "", 0), pending = false; });
    bus_.announce(rows);
  }
  void loop(bool) override { bus_.update(); }

 private:
  static void called(const char* name, const void* data, size_t size) { say(name, to_hex(data, size)); }
  BusSlave bus_;
};

static void run(Sketch& sketch, bool busy) {
  std::string word;
  while (std::cin >> word) {
    if (word == "!") {
      pending = false;
    } else if (word[0] != '+') {
      port.received += from_hex(word);
    } else {
      for (int left = atoi(word.c_str()); left > 0; --left) {
        sketch.loop(busy);
        ++now_ms;
        port.pass_ms();
      }
    }
  }
}

int main(int count, char** arguments) {
  const std::string kind = count > 1 ? arguments[1] : "";
  const std::set<std::string> options(arguments + (count > 1 ? 2 : 1), arguments + count);
  const bool busy = options.count("busy") != 0;
  if (kind == "packets") {
    PacketSketch sketch(options);
    run(sketch, busy);
  } else if (kind == "frames") {
    FrameSketch sketch(options);
    run(sketch, busy);
  } else if (kind == "bus") {
    BusSketch sketch;
    run(sketch, busy);
  } else {
    return 2;
  }
  return 0;
}
