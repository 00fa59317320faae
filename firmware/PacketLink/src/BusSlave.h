// A Slave on the robot-ctrl-bus (`bus`): calls a function for each request, and sends the reply.
//
// The port belongs to it: Serial.print breaks replies. Print to another port.
//
//   BusSlave bus(Serial);
//   BusResult pump(const Pump& pump) { …; return BusResult::ok(); }
//   BusResult tank() { …; return BusResult::ok(tank); }       // a packed struct
//   bus.on<Pump>(0x30, pump);                                 // in setup()
//   bus.on(0x32, tank);
//   bus.update();                                             // in loop(), often
//
// Replies go out in the order of the requests: while a function is pending, all others wait, ECHO too. The bridge
// relies on that: an ECHO that returns shows that no earlier reply can follow. A board without this library has to
// do the same. If it answered ECHO during a move, the late reply to the move could be taken for the next one's.
//
// See examples/Slave.

#ifndef BUSSLAVE_H
#define BUSSLAVE_H

#include "announcer.h"
#include "robot_ctrl_bus.h"
#include "stream_sink.h"

namespace serial_communication {

class BusSlave : private BusHandler {
 public:
  static const uint8_t kMaxHandlers = 8;
  static const uint16_t kMaxData = 300;  // bytes of DATE

  explicit BusSlave(Stream& port) : port_(port), slave_(StreamSink{&port}, *this) {}

  // Calls `handle` for each request of function `cmd2` (0 … 254) whose DATE is a T; a request with another size
  // gets ERROR 0x8001. False where cmd2 is 255 or has its function, or there are kMaxHandlers.
  template <class T>
  bool on(uint8_t cmd2, BusResult (*handle)(const T&)) {
    check_can_cross_the_wire<T>();
    static_assert(sizeof(T) <= 255, "a request for this holds no more");
    return add(cmd2, LeastSize<T>::value, sizeof(T), &call_with_data<T>, reinterpret_cast<void (*)()>(handle));
  }

  // Likewise for a function without DATE.
  bool on(uint8_t cmd2, BusResult (*handle)()) {
    return add(cmd2, 0, 0, &call_without_data, reinterpret_cast<void (*)()>(handle));
  }

  // Likewise for a function whose DATE has any length.
  bool on(uint8_t cmd2, BusResult (*handle)(const uint8_t* data, size_t size)) {
    return add(cmd2, 0, kMaxData, &call_with_bytes, reinterpret_cast<void (*)()>(handle));
  }

  // `ask` is called repeatedly after a function has returned BusResult::pending(), until it returns
  // another result, which is the reply. No other function is called meanwhile.
  void on_pending(BusResult (*ask)()) { ask_ = ask; }

  // `stop` is called at once when function 0x2F is requested while another one is pending. That one has to end
  // then; what was requested between the two is dropped.
  void on_stop(void (*stop)()) { stop_ = stop; }

  // Announces rows to the bridge, which asks for them where `bus/announcements` is true: see announcer.h. `text` is
  // an array in program memory (PROGMEM).
  template <size_t Size>
  void announce(const char (&text)[Size]) {
    announcer_.begin(text);
    get_chunk_ = &Chunks::get_from;
  }

  // Calls the functions for what was received: at most 64 bytes and some requests a call, so that loop() goes on
  // whatever the line brings.
  void update() {
    const uint32_t now = millis();
    // poll() has to see the silence behind everything that arrived before `now`. Where more waits, there is none.
    for (uint8_t left = kMaxReadAtOnce; left > 0 && !slave_.busy() && port_.available() > 0; --left) {
      slave_.feed(static_cast<uint8_t>(port_.read()), now);
    }
    slave_.poll(now);
  }

 private:
  typedef Announcer<sizeof(BusResult::data) - 4> Chunks;
  typedef BusResult (*Call)(void (*handle)(), const uint8_t* data, size_t size);
  struct Handler {
    uint8_t cmd2;
    uint8_t least;  // bytes of DATE
    uint16_t most;
    Call call;
    void (*handle)();
  };

  template <class T>
  static BusResult call_with_data(void (*handle)(), const uint8_t* data, size_t size) {
    return reinterpret_cast<BusResult (*)(const T&)>(handle)(from_received<T>(data, size));
  }

  static BusResult call_without_data(void (*handle)(), const uint8_t*, size_t) {
    return reinterpret_cast<BusResult (*)()>(handle)();
  }

  static BusResult call_with_bytes(void (*handle)(), const uint8_t* data, size_t size) {
    return reinterpret_cast<BusResult (*)(const uint8_t*, size_t)>(handle)(data, size);
  }

  bool add(uint8_t cmd2, uint8_t least, uint16_t most, Call call, void (*handle)()) {
    if (count_ == kMaxHandlers || cmd2 == kFunctionAnnouncement || find(cmd2)) return false;
    handlers_[count_++] = {cmd2, least, most, call, handle};
    return true;
  }

  const Handler* find(uint8_t cmd2) const {
    for (uint8_t i = 0; i < count_; ++i) {
      if (handlers_[i].cmd2 == cmd2) return handlers_ + i;
    }
    return 0;
  }

  BusResult request(uint8_t cmd2, const uint8_t* data, uint16_t size) override {
    if (cmd2 == kFunctionAnnouncement) return chunk(data, size);
    const Handler* handler = find(cmd2);
    const bool stops = cmd2 == kFunctionStop && stop_;
    if (!handler && !stops) return BusResult::failed(kErrorUnsupported);
    if (size < (handler ? handler->least : 0) || size > (handler ? handler->most : 0)) {
      return BusResult::failed(kErrorMalformed);
    }
    return handler ? handler->call(handler->handle, data, size) : BusResult::ok();  // the pending function has ended
  }

  BusResult chunk(const uint8_t* index, uint16_t size) const {
    BusResult result = BusResult::ok();
    if (size == 1 && get_chunk_) result.size = get_chunk_(announcer_, *index, result.data);
    return result.size > 0 ? result : BusResult::failed(kErrorUnsupported);
  }

  BusResult poll() override { return ask_ ? ask_() : BusResult::failed(kErrorOperation); }

  bool received_while_pending(uint8_t cmd2) override {
    if (cmd2 != kFunctionStop || !stop_) return false;
    stop_();
    return true;
  }

  Stream& port_;
  Chunks announcer_;
  uint8_t (*get_chunk_)(const Chunks&, uint8_t index, uint8_t* chunk) = 0;  // only where something is announced
  RobotCtrlBusSlave<StreamSink, kMaxData> slave_;
  Handler handlers_[kMaxHandlers];
  uint8_t count_ = 0;
  BusResult (*ask_)() = 0;
  void (*stop_)() = 0;
};

}  // namespace serial_communication

// Only these names need no serial_communication:: in a sketch; others, such as Packet, are free for its own.
using serial_communication::BusResult;
using serial_communication::BusSlave;
using serial_communication::kErrorMalformed;
using serial_communication::kErrorOperation;
using serial_communication::kErrorUnsupported;
using serial_communication::kFunctionEnvironment;
using serial_communication::kFunctionGimbal;
using serial_communication::kFunctionLift;

#endif
