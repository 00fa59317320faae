// Tests of the library on the PC, under sanitizers: `library_cases NAME [NUMBER]` runs one, in a fresh process. What it
// prints is for the test, or the condition that was false.

#include "library_sketch.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <string>

HardwareSerial Serial;
size_t room = 1000;
unsigned long now_ms = 0;
std::string received, sent;
unsigned long millis() { return now_ms; }
int HardwareSerial::available() { return int(received.size()); }
int HardwareSerial::read() {
  const uint8_t byte = uint8_t(received[0]);
  received.erase(0, 1);
  return byte;
}
size_t HardwareSerial::write(uint8_t byte) { return write(&byte, 1); }
size_t HardwareSerial::write(const uint8_t* bytes, size_t size) {
  if (size > room) size = room;
  sent.append(reinterpret_cast<const char*>(bytes), size);
  return size;
}

typedef void (*Run)();
struct Case {
  const char* name;
  Run run;
  Case* next;
  Case(const char* its_name, Run its_run) : name(its_name), run(its_run), next(all) { all = this; }
  static Case* all;
};
Case* Case::all = nullptr;
int number = 0;

#define CASE(name) static void name(); static Case case_##name(#name, name); static void name()
#define CASE_FOR_A_TEST CASE    // what it prints, or its number, is a test's
#define CHECK(condition) if (!(condition)) { puts(#condition); exit(1); }

const Force force = {0x0102};
const uint8_t bytes[64] = {0};

CASE(send_returns_whether_all_of_it_was_sent) {
  using serial_communication::MessageType;
  CHECK(packets.send(32, force) && sent.size() == 5)
  CHECK(frames.send(32, force))
  room = 4;
  CHECK(!packets.send(32, force) && !frames.send(32, force))
  room = 1000;
  sent.clear();
  CHECK(!packets.send(4, force) && !packets.send(255, force))        // types of the bridge itself
  CHECK(!frames.send(0x10, force) && !frames.send(0x01, force) && !frames.send(0xFF, force))
  CHECK(!packets.send(MessageType::Imu, bytes, 64))
  CHECK(!frames.send(40, bytes, 33))
  CHECK(sent.empty())
  CHECK(packets.send(MessageType::Imu, bytes, 63) && frames.send(40, bytes, 32))
  CHECK(packets.send(MessageType::Info, bytes, 64))                  // text is cut
}

CASE(reply_that_is_full_takes_no_more) {
  BusResult result = BusResult::ok();
  for (int i = 0; i < 8; ++i) CHECK(result.append_uint16(7))
  CHECK(!result.append_uint16(7) && result.size == 16)
}

CASE(a_handler_too_many_is_reported_to_the_bridge) {
  for (uint8_t type = 40; type < 48; ++type) CHECK(packets.on<Force>(type, take_force))
  packets.update();
  CHECK(sent.empty())
  CHECK(!packets.on<Force>(48, take_force))
  packets.update();
  CHECK(sent.find("too many") != std::string::npos)
  sent.clear();
  packets.update();
  CHECK(sent.empty())
  for (uint8_t cmd2 = 40; cmd2 < 48; ++cmd2) CHECK(bus.on<Force>(cmd2, ask_force))
  CHECK(!bus.on<Force>(48, ask_force))
}

CASE(a_second_handler_of_a_type_is_reported) {
  CHECK(packets.on<Force>(48, take_force) && !packets.on<Force>(48, take_force))
  packets.update();
  CHECK(sent.find("twice") != std::string::npos)
  CHECK(bus.on<Force>(48, ask_force) && !bus.on<Force>(48, ask_force))
  CHECK(!bus.on<Force>(255, ask_force))
}

CASE(bus_functions_answer) {
  static bool moving = false;
  static int stops = 0;
  bus.on<Force>(48, ask_force);
  bus.on(49, []() { moving = true; return BusResult::pending(); });
  // Request and reply are frames without their checksum.
  const auto frame = [](std::string bytes) {
    uint8_t checksum = 0;
    for (char byte : bytes) checksum ^= uint8_t(byte);
    return bytes.empty() ? bytes : bytes + char(checksum);
  };
  const auto answers = [&](const std::string& request, const std::string& reply) {
    sent.clear();
    received = frame(request);
    bus.update();
    return sent == frame(reply);
  };
  const std::string sync("\xa5\0\0\0", 4), move("\xa5\0\x55\x31", 4);
  const std::string stop("\xa5\0\x55\x2f", 4), ok("\xa5\0\x02", 3);
  const std::string unsupported("\xa5\x02\x03\0\x80", 5);
  const std::string malformed("\xa5\x02\x03\x01\x80"), failed("\xa5\x02\x03\x02\x80");
  CHECK(answers(sync, std::string("\xa5\0\0", 3)))
  CHECK(answers("\xa5\x02\x55\x30\x07\x08", "\xa5\x02\x02\x07\x08"))
  CHECK(answers("\xa5\x01\x55\x30\x07", malformed))
  CHECK(answers(stop, unsupported))
  bus.on_stop([]() { ++stops; moving = false; });
  CHECK(answers(stop, ok) && stops == 0)
  CHECK(answers(move, failed))                                        // there is no on_pending
  bus.on_pending([]() {
    return moving ? BusResult::pending() : BusResult::failed(kErrorOperation);
  });
  CHECK(answers(move, "") && answers(sync, ""))
  sent.clear();
  received = frame(stop);
  bus.update();
  CHECK(sent == frame(failed) + frame(ok) && stops == 1)              // the SYNC was dropped
}

CASE_FOR_A_TEST(a_handler_for_a_type_of_the_bridge_itself_is_reported) {
  CHECK(!packets.on<Force>(number, take_force))
  packets.update();
  CHECK(sent.find("13 ... 252") != std::string::npos)
}

CASE(commands_reach_their_functions) {
  static int speed = 0, pulse = 0, calibrations = 0;
  static std::string led;
  packets.on<Force>(48, take_force);
  received.assign("\x05\x30\x02\x01\x00", 5);
  packets.update();
  CHECK(taken == 0)                                            // another length
  received.assign("\x04\x30\x02\x01\x00" "\x04\x04\x90\x01\x00", 10);
  packets.update();
  CHECK(taken == 0x0102)
  packets.on_speed([](int16_t value) { speed = value; });
  packets.on_steering([](uint16_t value) { pulse = value; });
  packets.on_led([](const char* text) { led = text; });
  packets.on_calibration([]() { ++calibrations; });
  received.assign("\x04\x04\x18\xf0\x00" "\x04\x05\xdc\x05\x00" "\x06\x06left\x00"
                  "\x02\x0c\x00", 20);
  packets.update();
  CHECK(speed == -1000 && pulse == 1500 && led == "left" && calibrations == 1)
  now_ms = 70;
  CHECK(packets.heartbeat_age() == 0xFFFFFFFF)
  received.assign("\x02\x0b\x00", 3);
  packets.update();
  now_ms = 95;
  CHECK(packets.heartbeat_age() == 25)
  now_ms += 60001;
  packets.update();
  now_ms = 70 + 0x100000000;
  CHECK(packets.heartbeat_age() == 0xFFFFFFFF)
}

// A packet has its 50 ms of silence on the line, not between two calls of update().
CASE(a_packet_that_arrived_while_loop_was_delayed_is_taken) {
  packets.on<Force>(48, take_force);
  received.assign("\x04\x30", 2);
  packets.update();
  now_ms += 80;
  received.assign("\x02\x01\0", 3);
  packets.update();
  CHECK(taken == 0x0102)
}

CASE(a_packet_that_was_cut_short_takes_no_whole_one_with_it) {
  packets.on<Force>(48, take_force);
  received.assign("\x04\x30\x07", 3);
  packets.update();
  now_ms += 60;
  packets.update();
  received.assign("\x04\x30\x02\x01\0", 5);
  packets.update();
  CHECK(taken == 0x0102)
}

// So that loop() goes on, and the watchdog is served, whatever the line brings.
CASE(update_takes_at_most_64_bytes_a_call) {
  static int commands = 0;
  packets.on_calibration([]() { ++commands; });
  for (int i = 0; i < 100; ++i) received.append("\x02\x0c\0", 3);
  packets.update();
  CHECK(received.size() == 300 - 64 && commands == 21)
  while (!received.empty()) packets.update();
  CHECK(commands == 100)
  for (int i = 0; i < 100; ++i) received.append("\xa5\0\0\0\xa5", 5);
  bus.update();
  CHECK(received.size() == 500 - 8 * 5 && sent.size() == 8 * 4)
  while (!received.empty()) bus.update();
  CHECK(sent.size() == 100 * 4)
}

CASE(a_bus_request_in_two_pieces_of_64_bytes_is_not_called_invalid) {
  received.assign("\xa5\0\0\0\xa5", 5);
  received.append(60, '\x07');            // noise, which would be INVALID after a silence
  received.append("\xa5\0\0\0\xa6", 5);
  received.append("\xa5\0\0\0\xa5", 5);
  while (!received.empty()) {
    bus.update();
    ++now_ms;
  }
  now_ms += 100;
  bus.update();
  CHECK(sent == std::string("\xa5\0\0\xa5\xa5\0\0\xa5", 8))
}

// Each reply may wait for room in the send buffer, and the watchdog must not bite meanwhile.
CASE(requests_that_waited_are_answered_a_few_a_call) {
  static bool moving = true;
  bus.on(49, []() { return BusResult::pending(); });
  bus.on_pending([]() { return moving ? BusResult::pending() : BusResult::ok(); });
  received.assign("\xa5\0\0\0\xa5" "\xa5\0\x55\x31\xc1", 10);
  for (int i = 0; i < 40; ++i) received.append("\xa5\0\0\0\xa5", 5);
  while (!received.empty()) bus.update();
  CHECK(sent.size() == 4)
  moving = false;
  now_ms = 1000;
  size_t calls = 0;
  for (size_t before = 0; sent.size() != before; ++calls) {
    before = sent.size();
    bus.update();
    CHECK(sent.size() - before <= 9 * 4)
  }
  CHECK(sent.size() == 4 + 4 + 40 * 4 && calls >= 5)
}

CASE_FOR_A_TEST(a_command_of_another_size_is_said_once_a_type_and_second) {
  struct PortWithRoom : HardwareSerial {
    int room = 63;
    int availableForWrite() override { return room; }
    size_t write(const uint8_t* bytes, size_t size) override {
      waits += int(size) > room;
      sent.append(reinterpret_cast<const char*>(bytes), size);
      return size;
    }
    int waits = 0;
  } uart;

  PacketLink link(uart);
  link.on<Force>(48, take_force);
  link.on<Force>(148, take_force);
  const std::string wrong("\x05\x30\x07\x08\x09\0" "\x03\x94\x07\0", 10);
  for (; now_ms < 5000; ++now_ms) {
    received += wrong;
    link.update();
    if (now_ms == 0) uart.room = 10;               // too little
    if (now_ms == 2500) uart.room = 63;
  }
  CHECK(uart.waits == 0 && taken == 0)
  for (char byte : sent) putchar(byte == 0 ? '\n' : byte);
}

CASE(data_of_any_length_are_sent_and_received) {
  static std::string text;
  packets.on(50, [](const uint8_t* data, size_t size) {
    text.assign(reinterpret_cast<const char*>(data), size);
  });
  received.assign("\x05\x32" "abc\0", 6);
  packets.update();
  CHECK(text == "abc" && sent.empty())
  received.assign("\x02\x32\0", 3);
  packets.update();
  CHECK(text.empty())
  received.assign("\x40\x32" + std::string(62, 'x') + std::string(1, '\0'));
  while (!received.empty()) packets.update();
  CHECK(text == std::string(62, 'x'))
  CHECK(packets.send(51, "hello", 5) && sent == std::string("\x07\x33hello\0", 8))
  CHECK(packets.send(51, bytes, 0) && !packets.send(4, bytes, 2) && !packets.send(51, bytes, 64))
  sent.clear();
  CHECK(frames.send(51, "hello", 5) && sent.size() == 11)
  CHECK(!frames.send(0x10, bytes, 10) && !frames.send(0xFF, bytes, 10))
  bus.on(51, [](const uint8_t* data, size_t size) {
    text.assign(reinterpret_cast<const char*>(data), size);
    return BusResult::ok();
  });
  received.assign("\xa5\0\0\0\xa5" "\xa5\x03\x55\x33" "abc\xa0", 13);
  bus.update();
  CHECK(text == "abc")
}

CASE(a_struct_whose_text_has_any_length_takes_up_to_all_of_it) {
  struct PACKED Display {
    enum : uint16_t { LEAST = 1 };
    uint8_t line;
    char text[16];
  };
  static std::string shown;

  packets.on<Display>(50, [](const Display& display) {
    shown = char('0' + display.line) + std::string(display.text, strnlen(display.text, 16));
  });
  received.assign("\x07\x32\x02" "late\0", 8);
  packets.update();
  CHECK(shown == "2late")
  received.assign("\x03\x32\x01\0", 4);
  packets.update();
  CHECK(shown == "1" && sent.empty())
  received.assign("\x13\x32\x01" + std::string(16, 'x') + std::string(1, '\0'));
  packets.update();
  CHECK(shown == "1" + std::string(16, 'x'))
  received.assign("\x14\x32\x01" + std::string(17, 'y') + std::string(1, '\0'));
  packets.update();
  CHECK(shown == "1" + std::string(16, 'x') && sent.find("50 has 18 bytes") != std::string::npos)
}

CASE(a_rate_limit_lets_one_through_a_period) {
  RateLimit limit(1000);
  int passed = 0;
  now_ms = 0xFFFFF000;
  for (int i = 0; i < 10000; ++i) passed += limit.passes(uint32_t(now_ms++));
  CHECK(passed == 10)
}

// A port with the send buffer of an AVR, at 115200 baud; prints the time and what is sent.
struct Uart : HardwareSerial {
  int waiting = 0, waits = 0, tenths = 0;
  int availableForWrite() override { return 63 - waiting; }
  size_t write(const uint8_t* bytes, size_t size) override {
    waiting += int(size);
    if (waiting > 63) ++waits;
    printf("%lu ", now_ms);
    for (size_t i = 0; i < size; ++i) printf("%02x", bytes[i]);
    puts("");
    return size;
  }
  void pass() {
    ++now_ms;
    tenths += 115;
    for (; tenths >= 10; tenths -= 10) waiting -= waiting > 0;
  }
} uart;

#define ROW(type) "row_" #type ": {type: " #type ", ros_type: std_msgs/Bool, layout: <?, fields: [data]}\n"
static const char rows[] = "firmware: test 1.0\n" ROW(40) ROW(41) ROW(42) ROW(43) ROW(44);
CASE_FOR_A_TEST(print_rows) { fputs(rows, stdout); }

// Of 39 bytes every 10 ms, as the car sends, none finds too little room in the buffer.
CASE_FOR_A_TEST(chunks_beside_the_packets_of_the_car) {
  PacketLink bridge(uart);
  bridge.announce(rows);
  while (now_ms < 9000) {
    if (now_ms >= 7000 && now_ms % 10 == 0) received = std::string("\x02\x0b\0", 3);
    bridge.update();
    if (now_ms % 10 == 0) {
      for (int i = 0; i < 8; ++i) bridge.send_ticks(0);
      bridge.send_voltage(12);
    }
    uart.pass();
  }
  CHECK(uart.waits == 0)
}

CASE_FOR_A_TEST(chunks_between_the_frames_of_a_sensor_board) {
  FrameLink bridge(uart);
  bridge.announce(rows);
  for (; now_ms < 3050; uart.pass()) {
    bridge.update();
    if (now_ms % 50 == 0) bridge.send_sensor_status(SensorStatus());
  }
  CHECK(uart.waits == 0)
}

CASE_FOR_A_TEST(no_announcement) {
  PacketLink packets(uart);
  FrameLink frames(uart);
  received = std::string("\x02\x0b\0", 3);
  for (; now_ms < 5000; uart.pass()) {
    packets.update();
    frames.update();
  }
}

// Settings

#define SETTINGS(SETTING)                                                   \
  SETTING(1, gain, float, 0.5, 0, 10, "1/s", "a gain")                      \
  SETTING(2, period, uint16_t, 20, 5, 60000, "ms", "a period")              \
  SETTING(3, inverted, bool, 1, 0, 1, "", "whether it turns the other way") \
  SETTING(4, trim, int8_t, -5, -100, 100, "", "")                           \
  SETTING(5, position, int32_t, 0, -2147483647, 16777217, "", "")           \
  SETTING(200, mask, uint32_t, 7, 7, 4294967295, "", "")
SETTINGS(SETTING_VARIABLE)
constexpr Setting settings[] = {SETTINGS(SETTING_ENTRY)};
static const char setting_rows[] = "firmware: test 1.0\n" SETTINGS(SETTING_ROW);
CASE_FOR_A_TEST(print_setting_rows) { fputs(setting_rows, stdout); }

static std::string changes;
static void changed(uint8_t setting) { changes += char('0' + setting); }

static std::string float_bytes(float value) {
  return std::string(reinterpret_cast<const char*>(&value), sizeof value);
}

// Packets or frames with a setting each.
static std::string packet_of(const std::string& data) {
  uint8_t wire[16];
  const std::string packet = "\xfd" + data;
  return std::string(reinterpret_cast<const char*>(wire), serial_communication::cobs_encode(
      reinterpret_cast<const uint8_t*>(packet.data()), packet.size(), wire)) + std::string(1, '\0');
}
static std::string frame_of(const std::string& data, uint8_t sequence) {
  const std::string body = "\xfd" + std::string(1, char(sequence)) + data;
  uint8_t crc = 0;
  for (char byte : body) crc ^= uint8_t(byte);
  return "\x02" + std::string(1, char(body.size())) + body + char(crc) + "\x03";
}

static std::string answer(const std::string& request) {
  sent.clear();
  received = packet_of(request);
  packets.update();
  return sent;
}

CASE(a_board_answers_each_setting_with_the_value_in_use) {
  CHECK(packets.settings(settings, changed))
  packets.update();
  CHECK(sent == packet_of("\x01" + float_bytes(0.5f)))       // all are reported first
  for (int i = 0; i < 10; ++i) packets.update();
  const auto value = [](const char* bytes, size_t size) { return std::string(bytes, size); };
  const auto answers = [](const std::string& request, const std::string& reply) {
    return answer(request) == packet_of(reply);
  };
  CHECK(answers("\x01" + float_bytes(2.5f), "\x01" + float_bytes(2.5f)) && gain == 2.5f)
  CHECK(answers("\x01" + float_bytes(11), "\x01" + float_bytes(10)) && gain == 10)
  CHECK(answers("\x01" + float_bytes(-INFINITY), "\x01" + float_bytes(0)) && gain == 0)
  CHECK(changes == "111")
  CHECK(answers("\x01" + float_bytes(NAN), "\x01" + float_bytes(0)))    // it changes nothing
  CHECK(answers("\x01\x01", "\x01" + float_bytes(0)))                    // nor do other lengths
  CHECK(answers("\x01", "\x01" + float_bytes(0)))
  CHECK(answers("\x01" + float_bytes(0), "\x01" + float_bytes(0)))
  CHECK(changes == "111")
  CHECK(answers(value("\x02\x60\xea", 3), value("\x02\x60\xea", 3)) && period == 60000)
  CHECK(answers(value("\x02\xff\xff", 3), value("\x02\x60\xea", 3)))
  CHECK(answers(value("\x02\0\0", 3), value("\x02\x05\0", 3)) && period == 5)
  CHECK(answers(value("\x03\0", 2), value("\x03\0", 2)) && !inverted)
  CHECK(answers("\x03\x02", "\x03\x01") && inverted)
  CHECK(answers("\x04\x80", "\x04\x9c") && trim == -100)
  CHECK(answers(value("\x05\x01\0\0\x01", 5), value("\x05\x01\0\0\x01", 5)) && position == 16777217)
  CHECK(answers(value("\x05\x02\0\0\x01", 5), value("\x05\x01\0\0\x01", 5)))
  CHECK(answers("\xc8\xff\xff\xff\xff", "\xc8\xff\xff\xff\xff") && mask == 0xFFFFFFFF)
  CHECK(answers(value("\xc8\0\0\0\0", 5), value("\xc8\x07\0\0\0", 5)))
  CHECK(answer("\x09\x01").empty() && answer("").empty() && answer("\x01" + std::string(5, 'x')).empty())
}

CASE(settings_take_the_place_of_a_function) {
  for (uint8_t type = 40; type < 47; ++type) CHECK(packets.on<Force>(type, take_force))
  CHECK(packets.settings(settings))
  CHECK(!packets.on<Force>(47, take_force))
  packets.update();
  CHECK(sent.find("too many") != std::string::npos)
}

CASE(a_setting_among_anything_reaches_a_sensor_board) {
  frames.settings(settings, changed);
  for (int i = 0; i < 10; ++i) frames.update();
  uint32_t random = 1;
  uint8_t number = 6;                                        // of the board's next frame
  for (int round = 1; round < 20000; ++round) {
    random = random * 1664525 + 1013904223;
    const float wanted = float(round % 1000) / 100;
    const std::string frame = frame_of("\x01" + float_bytes(wanted), uint8_t(random >> 24));
    // A beginning of it, and noise like it.
    received = frame.substr(0, (random >> 8) % 11) + std::string(random >> 12 & 3, "\x02\x07\xfd\x03"[random >> 16 & 3]);
    received += frame;
    gain = -1;
    sent.clear();
    while (!received.empty()) frames.update();
    frames.update();
    CHECK(gain == wanted && sent == frame_of("\x01" + float_bytes(wanted), number++))
  }
  sent.clear();
  received = frame_of("\x01" + float_bytes(1), 0);
  received[6] = char(received[6] ^ 1);
  received += frame_of("\x09\x01", 1) + frame_of("\x01" + std::string(5, 'x'), 2) + frame_of("", 3);
  for (int i = 0; i < 10; ++i) frames.update();
  CHECK(sent.empty())
}

CASE_FOR_A_TEST(settings_beside_the_packets_of_the_car) {
  PacketLink bridge(uart);
  bridge.announce(setting_rows);
  bridge.settings(settings);
  while (now_ms < 9000) {
    if (now_ms % 50 == 0) received = packet_of("\x02" + std::string("\x10\0", 2));
    bridge.update();
    if (now_ms % 10 == 0) {
      for (int i = 0; i < 8; ++i) bridge.send_ticks(0);
      bridge.send_voltage(12);
    }
    uart.pass();
  }
}

template <typename Link> void settings_alone() {
  Link bridge(uart);
  bridge.settings(settings);
  for (; now_ms < 20000; uart.pass()) bridge.update();
}
CASE_FOR_A_TEST(settings_alone_in_packets) { settings_alone<PacketLink>(); }
CASE_FOR_A_TEST(settings_alone_in_frames) { settings_alone<FrameLink>(); }

int main(int count, char** arguments) {
  if (count > 2) number = atoi(arguments[2]);
  for (Case* each = Case::all; each != nullptr; each = each->next) {
    if (count > 1 && strcmp(each->name, arguments[1]) == 0) return each->run(), 0;
  }
  return 2;
}
