// Drives the protocol headers from a test: one command a line on stdin, one line of answer each.
//
//   encode HEX | decode HEX                       COBS
//   packet TYPE HEX                               a packet on the wire, from type and data
//   speed N | steering N | angle N | ticks N | voltage F | heartbeat | calibration
//   text TYPE TEXT | imu N*11                     the typed senders
//   parse TOKEN…                                  packets out of a stream, then the counters
//   bus TOKEN…                                    the Slave's replies after each token, then what was executed
//   skip N | sensor N*5 | adc N*6                 the STX/ETX sender; skip sends N frames to nowhere
//   time packet N N | time frame N                the board's time: µs, and of how many packets
//   custom packet|frame N N F                        a custom packed struct: int16, uint8, float
//   watch TOKEN…                                  a heartbeat watch of 31 ticks: after each tick, whether it is alive.
//                                                 aN: N bytes arrive; rN: N are read; h1: a heartbeat; tN: N ticks
//
// A token is HEX (bytes arriving now), +N (N ms pass, polled each ms) or, for the bus, ! (the motion ends).

#include <arduino_packets.h>
#include <heartbeat_watch.h>
#include <robot_ctrl_bus.h>
#include <stx_etx.h>

#include <cstdio>
#include <iostream>
#include <sstream>
#include <string>
#include <vector>

using namespace serial_communication;

typedef std::vector<uint8_t> Bytes;

// A custom message: type 48 of a packet, 0x30 of a function and of a frame.
struct PACKED Custom {
  int16_t position;
  uint8_t force;
  float speed;
};

static Bytes from_hex(const std::string& text) {
  Bytes bytes;
  for (size_t i = 0; i + 1 < text.size(); i += 2) bytes.push_back(uint8_t(std::stoi(text.substr(i, 2), nullptr, 16)));
  return bytes;
}

static std::string to_hex(const uint8_t* bytes, size_t size) {
  std::string text;
  char digits[3];
  for (size_t i = 0; i < size; ++i) {
    snprintf(digits, sizeof digits, "%02x", bytes[i]);
    text += digits;
  }
  return text;
}

struct Collect {
  std::string* out;
  bool operator()(const uint8_t* bytes, size_t size) const {
    *out += to_hex(bytes, size);
    return true;
  }
};

// A board whose lift takes until it is told to end, and whose other functions answer at once.
class TestBoard : public BusHandler {
 public:
  bool moving = false;
  std::string executed;

  BusResult request(uint8_t cmd2, const uint8_t* data, uint16_t size) override {
    char name[8];
    snprintf(name, sizeof name, " %02x:", cmd2);
    executed += name + to_hex(data, size);
    if (cmd2 == kFunctionEnvironment) {
      BusResult result = BusResult::ok();
      result.append_uint16(350);
      result.append_uint16(2563);
      result.append_uint16(4812);
      return result;
    }
    Custom custom;
    if (cmd2 == 0x30) return from_bytes(data, size, &custom) ? BusResult::ok(custom) : BusResult::failed(kErrorMalformed);
    if (cmd2 == kFunctionGimbal) return size == 2 && data[0] <= 3 ? BusResult::ok() : BusResult::failed(kErrorMalformed);
    if (cmd2 != kFunctionLift) return BusResult::failed(kErrorUnsupported);
    moving = true;
    return BusResult::pending();
  }

  BusResult poll() override { return moving ? BusResult::pending() : BusResult::ok(); }

  bool received_while_pending(uint8_t cmd2) override {
    if (cmd2 != kFunctionStop) return false;
    moving = false;
    return true;
  }
};

static std::string run_bus(std::istringstream& tokens) {
  std::string sent, line, token;
  TestBoard board;
  RobotCtrlBusSlave<Collect, 300> slave(Collect{&sent}, board);
  uint32_t now = 1000;
  while (tokens >> token) {
    if (token == "!") {
      board.moving = false;
      slave.poll(now);
    } else if (token[0] == '+') {
      for (int i = std::stoi(token.substr(1)); i > 0; --i) {
        ++now;
        slave.poll(now);
      }
    } else {
      for (uint8_t byte : from_hex(token)) slave.feed(byte, now);
      slave.poll(now);
    }
    line += (sent.empty() ? "-" : sent) + " ";
    sent.clear();
  }
  return line + "|" + board.executed;
}

static std::string run_parse(std::istringstream& tokens) {
  PacketDecoder<256> decoder;
  decoder.accept<Custom>(48);
  std::string line, token;
  uint32_t now = 1000;
  while (tokens >> token) {
    if (token[0] == '+') {
      for (int i = std::stoi(token.substr(1)); i > 0; --i) decoder.poll(++now);
      continue;
    }
    for (uint8_t byte : from_hex(token)) {
      if (!decoder.feed(byte, now)) continue;
      const Packet& packet = decoder.packet();
      line += std::to_string(int(packet.type)) + ":" + to_hex(packet.data, packet.size);
      if (packet.type == MessageType::SpeedCmd) line += "=" + std::to_string(packet.speed());
      if (packet.type == MessageType::SteeringCmd) line += "=" + std::to_string(packet.value());
      if (packet.type == MessageType::Voltage) line += "=" + std::to_string(packet.voltage());
      if (packet.type == MessageType::LedCmd && packet.text_is("left")) line += "=left";
      if (packet.type == MessageType::Imu) {
        uint8_t again[kImuDataSize];
        imu_to_bytes(packet.imu(), again);
        line += "=" + to_hex(again, sizeof again);
      }
      Custom custom;
      if (packet.is(48, &custom)) line += "=" + std::to_string(custom.position) + "/" + std::to_string(custom.force);
      line += " ";
    }
  }
  const auto& c = decoder.counters;
  std::ostringstream counters;
  counters << "| cobs=" << c.cobs_errors << " long=" << c.too_long << " length=" << c.wrong_length
           << " unknown=" << c.unknown_type << " timeout=" << c.timeouts;
  return line + counters.str();
}

static std::string run_watch(std::istringstream& tokens) {
  HeartbeatWatch watch;
  std::string line, token;
  uint8_t waiting = 0;
  while (tokens >> token) {
    for (int left = std::stoi(token.substr(1)); left > 0; --left) {
      if (token[0] == 'a') ++waiting;
      if (token[0] == 'r') --waiting, watch.byte_read();
      if (token[0] == 'h') watch.heartbeat();
      if (token[0] == 't') watch.tick(waiting), line += watch.alive() ? '1' : '0';
    }
  }
  return line;
}

int main() {
  std::string line, out;
  PacketSender<Collect, 255> packets(Collect{&out});
  StxEtxSender<Collect> frames(Collect{&out});
  while (std::getline(std::cin, line)) {
    std::istringstream words(line);
    std::string command;
    words >> command;
    out.clear();
    long number = 0;
    if (command == "encode") {
      std::string hex;
      words >> hex;
      const Bytes in = from_hex(hex);
      Bytes encoded(cobs_encoded_max(in.size()));
      out = to_hex(encoded.data(), cobs_encode(in.data(), in.size(), encoded.data()));
    } else if (command == "decode") {
      std::string hex;
      words >> hex;
      Bytes in = from_hex(hex);
      size_t size = 0;
      out = cobs_decode(in.data(), in.size(), in.data(), &size) ? to_hex(in.data(), size) : "rejected";
    } else if (command == "packet") {
      std::string hex;
      words >> number >> hex;
      const Bytes data = from_hex(hex);
      packets.send(static_cast<MessageType>(number), data.data(), data.size());
    } else if (command == "speed" && words >> number) {
      packets.send_speed(int16_t(number));
    } else if (command == "steering" && words >> number) {
      packets.send_steering(uint16_t(number));
    } else if (command == "angle" && words >> number) {
      packets.send_steering_angle(uint16_t(number));
    } else if (command == "ticks" && words >> number) {
      packets.send_ticks(uint8_t(number));
    } else if (command == "voltage") {
      float volts;
      words >> volts;
      packets.send_voltage(volts);
    } else if (command == "heartbeat") {
      packets.send_heartbeat();
    } else if (command == "calibration") {
      packets.send_imu_calibration();
    } else if (command == "text") {
      std::string text;
      words >> number >> std::ws;
      std::getline(words, text);
      packets.send_text(static_cast<MessageType>(number), text.c_str());
    } else if (command == "imu") {
      ImuData imu;
      for (int16_t& v : imu.quaternion) words >> v;
      for (int16_t& v : imu.angular_velocity) words >> v;
      for (int16_t& v : imu.acceleration) words >> v;
      words >> imu.temperature;
      packets.send_imu(imu);
    } else if (command == "parse") {
      out = run_parse(words);
    } else if (command == "bus") {
      out = run_bus(words);
    } else if (command == "watch") {
      out = run_watch(words);
    } else if (command == "skip" && words >> number) {
      for (long i = 0; i < number; ++i) frames.send(0x7F, nullptr, 0);
      out = "ok";
    } else if (command == "sensor") {
      SensorStatus status;
      words >> status.range_mm[0] >> status.range_mm[1] >> status.yaw >> status.pitch >> status.roll;
      frames.send_sensor_status(status);
    } else if (command == "time") {
      std::string kind;
      uint32_t microseconds;
      words >> kind >> microseconds;
      if (kind == "packet") {
        words >> number;
        packets.time(microseconds, uint8_t(number));
      } else {
        frames.time(microseconds);
      }
    } else if (command == "custom") {
      std::string kind;
      int force;
      float speed;
      words >> kind >> number >> force >> speed;
      const Custom custom = {int16_t(number), uint8_t(force), speed};
      if (kind == "packet") {
        packets.send(48, custom);
      } else {
        frames.send(0x30, custom);
      }
    } else if (command == "adc") {
      uint16_t channels[6];
      for (uint16_t& channel : channels) words >> channel;
      frames.send_adc_status(channels);
    } else {
      out = "error";
    }
    std::cout << out << std::endl;
  }
}
