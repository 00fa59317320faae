// What the protocol headers make of pseudo-random input, as one number: it has to be the same on every processor.
// Prints it in hexadecimal. For the PC, or for QEMU's Xtensa with nothing below it.

#include <arduino_packets.h>
#include <robot_ctrl_bus.h>
#include <stx_etx.h>
#include <string.h>

using namespace serial_communication;

#if defined(__XTENSA__)
extern "C" {
void* memcpy(void* to, const void* from, size_t size) {
  for (size_t i = 0; i < size; ++i) static_cast<volatile uint8_t*>(to)[i] = static_cast<const uint8_t*>(from)[i];
  return to;
}
void* memmove(void* to, const void* from, size_t size) {
  volatile uint8_t* const out = static_cast<uint8_t*>(to);
  const uint8_t* const in = static_cast<const uint8_t*>(from);
  if (out < in) return memcpy(to, from, size);
  for (size_t i = size; i > 0; --i) out[i - 1] = in[i - 1];
  return to;
}
void* memset(void* to, int value, size_t size) {
  for (size_t i = 0; i < size; ++i) static_cast<volatile uint8_t*>(to)[i] = static_cast<uint8_t>(value);
  return to;
}
int memcmp(const void* a, const void* b, size_t size) {
  for (size_t i = 0; i < size; ++i) {
    const int difference = static_cast<const uint8_t*>(a)[i] - static_cast<const uint8_t*>(b)[i];
    if (difference) return difference;
  }
  return 0;
}
size_t strlen(const char* text) {
  size_t size = 0;
  while (static_cast<const volatile char*>(text)[size]) ++size;
  return size;
}
void __cxa_pure_virtual() {}
void __cxa_atexit() {}
void* __dso_handle;
}
void operator delete(void*, size_t) {}
// QEMU's semihosting: 4 writes to the output, 1 ends the program.
static int simulator(int number, int a, const void* b, int c) {
  register int a2 asm("a2") = number;
  register int a3 asm("a3") = a;
  register const void* a4 asm("a4") = b;
  register int a5 asm("a5") = c;
  asm volatile("simcall" : "+r"(a2), "+r"(a3) : "r"(a4), "r"(a5) : "memory");
  return a2;
}
static void print(const char* text, int size) { simulator(4, 1, text, size); }
#else
#include <unistd.h>
static void print(const char* text, int size) { if (write(1, text, static_cast<size_t>(size)) != size) _exit(1); }
#endif

static uint32_t hash = 2166136261u, state = 1;  // FNV-1a; xorshift

static void add(const uint8_t* bytes, size_t size) {
  for (size_t i = 0; i < size; ++i) hash = (hash ^ bytes[i]) * 16777619u;
}

static void add(uint32_t number) {
  const uint8_t bytes[4] = {uint8_t(number), uint8_t(number >> 8), uint8_t(number >> 16), uint8_t(number >> 24)};
  add(bytes, sizeof bytes);
}

static uint32_t any() {
  state ^= state << 13;
  state ^= state >> 17;
  return state ^= state << 5;
}

// 0 … size - 1. Debian's compiler for the Xtensa has no division and no arithmetic with floats.
static uint32_t below(uint16_t size) { return (any() >> 16) * size >> 16; }

static float any_float() {
  const uint32_t bits = any() & 0x7EFFFFFF;  // neither infinite nor NaN
  float number;
  memcpy(&number, &bits, sizeof number);
  return number;
}

static uint32_t bits_of(float number) {
  uint32_t bits;
  memcpy(&bits, &number, sizeof bits);
  return bits;
}

struct PACKED Custom {
  uint8_t force;
  int16_t position;
  float speed;
};

// What the headers send is hashed, and kept as input for the decoders.
static uint8_t wire[4096];
static size_t wire_size = 0;

struct Keep {
  bool operator()(const uint8_t* bytes, size_t size) const {
    add(bytes, size);
    for (size_t i = 0; i < size && wire_size < sizeof wire; ++i) wire[wire_size++] = bytes[i];
    return true;
  }
};

struct Board : BusHandler {
  BusResult request(uint8_t cmd2, const uint8_t* data, uint16_t size) override {
    add(cmd2);
    add(data, size);
    Custom custom;
    if (cmd2 == 0x30 && from_bytes(data, size, &custom)) return BusResult::ok(custom);
    return BusResult::failed(kErrorUnsupported);
  }
  BusResult poll() override { return BusResult::ok(); }
};

static void send() {
  PacketSender<Keep, 255> packets(Keep{});
  StxEtxSender<Keep> frames(Keep{});
  uint8_t data[60];
  for (int round = 0; round < 40; ++round) {
    for (uint8_t& byte : data) byte = below(3) ? uint8_t(any()) : 0;
    const MessageType type = static_cast<MessageType>(below(256));
    packets.send(type, data, below(sizeof data));
    Custom custom = {uint8_t(any()), int16_t(any()), any_float()};
    packets.send(48, custom);
    frames.send(0x30, custom);
    packets.send_speed(int16_t(any()));
    packets.send_voltage(any_float());
    ImuData imu;
    for (int16_t& v : imu.quaternion) v = int16_t(any());
    for (int16_t& v : imu.angular_velocity) v = int16_t(any());
    for (int16_t& v : imu.acceleration) v = int16_t(any());
    imu.temperature = int16_t(any());
    packets.send_imu(imu);
    SensorStatus status = {{uint16_t(any()), uint16_t(any())}, int32_t(below(36000)), int16_t(any()), int16_t(any())};
    frames.send_sensor_status(status);
  }
}

// Every byte three times: as it was sent, and with some of them changed.
static void receive() {
  PacketDecoder<256> decoder;
  decoder.accept<Custom>(48);
  Board board;
  RobotCtrlBusSlave<Keep, 300> slave(Keep{}, board);
  const size_t size = wire_size;
  for (int pass = 0; pass < 3; ++pass) {
    for (size_t i = 0; i < size; ++i) {
      const uint8_t byte = pass > 0 && below(20) == 0 ? uint8_t(any()) : wire[i];
      const uint32_t now = uint32_t(i);
      if (decoder.feed(byte, now)) {
        const Packet& packet = decoder.packet();
        add(uint32_t(packet.type));
        add(packet.data, packet.size);
        if (packet.type == MessageType::SpeedCmd) add(uint32_t(packet.speed()));
        if (packet.type == MessageType::Voltage) add(bits_of(packet.voltage()));
        Custom custom;
        if (packet.is(48, &custom)) add(uint32_t(custom.position) ^ bits_of(custom.speed));
      }
      decoder.poll(now);
      slave.feed(byte, now);
      slave.poll(now);
    }
    // Valid requests, too, whose bytes noise does not make.
    uint8_t request[] = {0xA5, 7, 0x55, 0x30, uint8_t(any()), uint8_t(any()), 3, 4, 5, 6, 7, 0};
    for (size_t i = 0; i + 1 < sizeof request; ++i) request[sizeof request - 1] ^= request[i];
    const uint8_t sync[] = {0xA5, 0, 0, 0, 0xA5};
    for (uint8_t byte : sync) slave.feed(byte, 100000);
    slave.poll(100000);
    for (uint8_t byte : request) slave.feed(byte, 100001);
    slave.poll(100001);
  }
}

int main() {
  send();
  receive();
  char text[9] = "00000000";
  for (int i = 0; i < 8; ++i) text[i] = "0123456789abcdef"[hash >> (28 - 4 * i) & 15];
  text[8] = '\n';
  print(text, sizeof text);
#if defined(__XTENSA__)
  simulator(1, 0, nullptr, 0);
#endif
  return 0;
}

#if defined(__XTENSA__)
// The machine starts here; the stack is above the program.
asm(".section .start, \"ax\"\n"
    ".global _start\n"
    "_start:\n"
    "  j 1f\n"
    "  .align 4\n"
    "  .literal_position\n"
    "1:\n"
    "  movi a1, 0x50100000\n"
    "  call0 main\n"
    ".previous\n");
#endif
