// Sketches with the library's links, on the PC under sanitizers; their port and their clock are a script's.
//
//   pc_board packets|frames|bus [OPTION …] < SCRIPT
//
// SCRIPT has words: HEX: these bytes arrive; +N: N ms pass, in each of which loop() runs once.
// A line is printed for each write, `MS sent HEX`, and for each function that is called, `MS NUMBER HEX`.
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

// The sketches; each is alone in its process.

static std::set<std::string> options;
static PacketLink packets(port);
static FrameLink frames(port);
static BusSlave bus(port);
static bool pending = false;

template <class Link>
void announce_and_set(Link& link) {
  if (options.count("rows")) link.announce(rows);
  if (options.count("settings")) link.settings(settings, changed);
}

static void setup_packets() {
  packets.on<Force>(48, [](const Force& force) { say("48", to_hex(&force, sizeof force)); });
  packets.on(50, [](const uint8_t* data, size_t size) { say("50", to_hex(data, size)); });
  // Sends a packet: the type is the first of these bytes.
  packets.on(52, [](const uint8_t* data, size_t size) { packets.send(MessageType(data[0]), data + 1, size - 1); });
  packets.on_steering([](uint16_t pulse) { say("5", to_hex(&pulse, sizeof pulse)); });
  packets.on_calibration([]() { say("12", ""); });
  announce_and_set(packets);
}

static void loop_packets() {
  packets.update();
  if (!options.count("busy") || now_ms % 10 != 0) return;
  for (int i = 0; i < 8; ++i) packets.send_ticks(0);  // 39 bytes, as many as the car sends
  packets.send_voltage(12);
}

static void setup_frames() { announce_and_set(frames); }

static void loop_frames() {
  frames.update();
  const uint16_t channels[6] = {1, 2, 300, 4, 5, 1023};
  if (options.count("busy") && now_ms % 50 == 0) frames.send_adc_status(channels);
}

static void setup_bus() {
  bus.on(49, []() { return say("49", ""), pending = true, BusResult::pending(); });
  bus.on(51, [](const uint8_t* data, size_t size) { return say("51", to_hex(data, size)), BusResult::ok(); });
  bus.on_pending([]() { return pending ? BusResult::pending() : BusResult::ok(); });
  bus.on_stop([]() { say("stop", ""), pending = false; });
}

static void loop_bus() { bus.update(); }

static void run(void (*loop)()) {
  std::string word;
  while (std::cin >> word) {
    if (word[0] != '+') {
      port.received += from_hex(word);
      continue;
    }
    for (int left = atoi(word.c_str()); left > 0; --left) {
      loop();
      ++now_ms;
      port.pass_ms();
    }
  }
}

int main(int count, char** arguments) {
  if (count < 2) return 2;
  const std::string kind = arguments[1];
  options.insert(arguments + 2, arguments + count);
  if (kind == "packets") setup_packets(), run(loop_packets);
  if (kind == "frames") setup_frames(), run(loop_frames);
  if (kind == "bus") setup_bus(), run(loop_bus);
  return 0;
}
