// The Slave of robot-ctrl-bus: the control board's end of a strict one-request-one-reply link.
//
//   request:  | Flag | Datelen | CMD1 | CMD2 | DATE … | Checksum |
//   reply:    | Flag | Datelen | CMD1 | DATE …        | Checksum |
//
// Flag 0xA5: Datelen is one byte, below 255. Flag 0x5A: Datelen is a uint16, little-endian.
// Datelen counts the DATE bytes. Checksum is the XOR of every byte before it.
//
// Rules, so that the Master's view is always true:
// - One reply a request. A request that is received during a motion waits in the Slave's buffer and is
//   answered after it, in order: an ECHO that returns proves that everything requested before has ended.
//   When the buffer is full, all whole requests in it are dropped without a reply: the Master no longer
//   waits for theirs.
// - The handler is informed of a request at once, so that a stop can end the motion; see
//   BusHandler::received_while_pending.
// - A failed check gives up one byte, not a frame: a frame that begins inside a false start is found.
//   INVALID goes out only when nothing of the damaged bytes can still become a frame and the line has been
//   silent for a moment; a valid frame in the same burst of bytes takes its place. Otherwise the Master
//   would take a lift for not executed that is executed a moment later, and send it again.
//   For the same reason all bytes that have arrived have to be fed before poll() is called.
// - An incomplete frame is given up without a reply after the frame timeout without a byte; then the Master's timeout
//   passes. It is also given up when its bytes come slower than one a millisecond, and are late by the frame timeout:
//   otherwise noise behind a false start could hold back a stop for as long as the length in it says.
//
// BusSlave.h uses this; a sketch includes that one.

#ifndef SERIAL_COMMUNICATION_ROBOT_CTRL_BUS_H
#define SERIAL_COMMUNICATION_ROBOT_CTRL_BUS_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#include "packed.h"

namespace serial_communication {

const uint8_t kFlagStandard = 0xA5;
const uint8_t kFlagLong = 0x5A;

// The requests that are executed between two calls of poll(). Each reply may have to wait for room in the send buffer,
// and the program must not stand still for long.
const uint8_t kRequestsAtOnce = 8;

// An INVALID is sent when the line has been silent for this time.
const uint8_t kInvalidSilenceMs = 5;

// Of an incomplete frame: 9600 baud.
const uint8_t kMostMsPerByte = 1;

// CMD1 of requests
const uint8_t kCmdSync = 0x00;
const uint8_t kCmdEcho = 0x01;
const uint8_t kCmdFunction = 0x55;
// CMD1 of replies; SYNC and ECHO are answered under their own number
const uint8_t kReplyOk = 0x02;
const uint8_t kReplyError = 0x03;
const uint8_t kReplyInvalid = 0xFF;
// CMD2
const uint8_t kFunctionLift = 0x20;
const uint8_t kFunctionGimbal = 0x21;
const uint8_t kFunctionEnvironment = 0x22;
// Not in the protocol's specification: ends the motion under way. Boards may offer it.
const uint8_t kFunctionStop = 0x2F;
const uint8_t kFunctionAnnouncement = 0xFF;
// INVALID: the frame was not accepted
const uint8_t kInvalidChecksum = 0x40;
const uint8_t kInvalidTooLong = 0x20;
const uint8_t kInvalidNotSynchronised = 0x10;
// ERROR: understood, and failed
const uint16_t kErrorUnsupported = 0x8000;
const uint16_t kErrorMalformed = 0x8001;
const uint16_t kErrorOperation = 0x8002;

// The result of a function. OK carries `size` bytes of `data`, Error its `error`.
struct BusResult {
  enum Outcome : uint8_t { Ok, Error, Pending };

  Outcome outcome;
  uint16_t error;
  uint8_t data[16];
  uint8_t size;

  static BusResult ok() { return BusResult{Ok, 0, {0}, 0}; }
  // OK with a packed struct, for a custom function.
  template <class T>
  static BusResult ok(const T& value) {
    BusResult result = ok();
    check_can_cross_the_wire<T>();
    static_assert(sizeof(T) <= sizeof result.data, "a reply holds no more");
    memcpy(result.data, &value, sizeof value);
    result.size = sizeof value;
    return result;
  }

  static BusResult failed(uint16_t error) { return BusResult{Error, error, {0}, 0}; }
  static BusResult pending() { return BusResult{Pending, 0, {0}, 0}; }

  // False: the reply is full, and unchanged.
  bool append_uint16(uint16_t value) {
    if (size + sizeof value > sizeof data) return false;
    data[size++] = static_cast<uint8_t>(value);
    data[size++] = static_cast<uint8_t>(value >> 8);
    return true;
  }
};

// What the board does with requests of CMD1 0x55. Neither call may wait.
class BusHandler {
 public:
  // Starts function `cmd2`. Pending: it takes time, and poll() returns the result when it has ended. The data
  // of a custom function is a packed struct: from_bytes(data, size, &value), else kErrorMalformed.
  virtual BusResult request(uint8_t cmd2, const uint8_t* data, uint16_t size) = 0;
  // Called by the Slave's poll() while a function is pending.
  virtual BusResult poll() = 0;
  // Function `cmd2` was requested while another one is pending; request() follows after that. True: what was
  // requested between the two is not executed any more, and gets no reply.
  virtual bool received_while_pending(uint8_t) { return false; }

 protected:
  ~BusHandler() {}
};

// `Sink` is any callable (const uint8_t* bytes, size_t size); a reply takes several calls.
// `MaxData` bounds the DATE of a request, and with it the buffer: 300 hold 34 ECHOs during a motion.
template <class Sink, uint16_t MaxData = 255>
class RobotCtrlBusSlave {
 public:
  struct Counters {
    uint16_t requests;
    uint16_t checksum_errors;
    uint16_t too_long;
    uint16_t garbage_bytes;
    uint16_t timeouts;
    uint16_t overruns;
  };

  RobotCtrlBusSlave(Sink sink, BusHandler& handler, uint32_t frame_timeout_ms = 50)
      : counters(), sink_(sink), handler_(handler), frame_timeout_ms_(frame_timeout_ms) {}

  bool synchronised() const { return synchronised_; }

  // Whether requests wait for the next poll(): what is fed now may be dropped.
  bool busy() const { return requests_left_ == 0; }

  // Has to be called for each byte, whether a function is pending or not.
  void feed(uint8_t byte, uint32_t now_ms) {
    last_byte_ms_ = now_ms;
    if (size_ == kBufferSize) {  // only while a function is pending, or busy()
      ++counters.overruns;
      drop(pending_ ? whole_ : size_);
      whole_ = 0;
    }
    if (size_ == whole_) next_frame_ = true;
    buffer_[size_++] = byte;
    if (pending_) {
      look_ahead();
    } else {
      scan();
    }
  }

  // Has to be called often, after feed(): ends a pending function, and gives up incomplete frames.
  void poll(uint32_t now_ms) {
    const uint32_t silence = now_ms - last_byte_ms_;
    const bool silent = silence >= frame_timeout_ms_;
    requests_left_ = kRequestsAtOnce;
    scan();
    if (next_frame_) begun_ms_ = now_ms;
    next_frame_ = false;
    // After a silence nothing is left; of a late frame one byte goes, and what is behind that has its own time.
    bool give_up = silent || now_ms - begun_ms_ >= frame_timeout_ms_ + (size_ - whole_) * kMostMsPerByte;
    if (pending_) {
      for (; give_up && whole_ < size_; give_up = silent) {
        ++whole_;
        next_frame_ = true;
        look_ahead();
      }
      const BusResult result = handler_.poll();
      if (result.outcome == BusResult::Pending) return;
      pending_ = false;
      whole_ = 0;
      reply(result);
      scan();
    }
    for (; give_up && size_ > 0 && !pending_ && !busy(); give_up = silent) {
      ++counters.timeouts;
      drop(1);
      scan();
    }
    if (invalid_ != 0 && size_ == 0 && !pending_ && silence >= kInvalidSilenceMs) {
      reply_invalid(invalid_);
      invalid_ = 0;
    }
  }

  Counters counters;

 private:
  static const uint16_t kBufferSize = MaxData + 6;  // a long frame's five bytes of header, and the checksum
  enum class Check : uint8_t { Incomplete, Complete, ChecksumError, TooLong, NoFrame };

  // Handles every frame in the buffer, and leaves at most the beginning of one, unless it becomes busy.
  void scan() {
    while (size_ > 0 && !pending_ && !busy()) {
      if (buffer_[0] != kFlagStandard && buffer_[0] != kFlagLong) {
        drop_to_flag();
        continue;
      }
      switch (check(0)) {
        case Check::Incomplete:
          return;
        case Check::Complete:
          invalid_ = 0;
          ++counters.requests;
          --requests_left_;
          execute();
          drop(frame_size_);
          if (pending_) look_ahead();
          break;
        case Check::ChecksumError:
          ++counters.checksum_errors;
          note_invalid(kInvalidChecksum);
          drop(1);
          break;
        case Check::TooLong:
          ++counters.too_long;
          note_invalid(kInvalidTooLong);
          drop(1);
          break;
        case Check::NoFrame:
          ++counters.garbage_bytes;
          drop(1);
          break;
      }
    }
  }

  // While a function is pending: informs the handler of the requests that wait, each once. `whole_` is the end of
  // the last of them.
  void look_ahead() {
    while (whole_ < size_) {
      const uint8_t* frame = buffer_ + whole_;
      const bool flag = frame[0] == kFlagStandard || frame[0] == kFlagLong;
      const Check found = flag ? check(whole_) : Check::NoFrame;
      if (found == Check::Incomplete) return;
      next_frame_ = true;
      if (found != Check::Complete) {
        ++whole_;
      } else if (frame[header_size_ - 2] == kCmdFunction && handler_.received_while_pending(frame[header_size_ - 1])) {
        drop(whole_);
        whole_ = frame_size_;
      } else {
        whole_ += frame_size_;
      }
    }
  }

  // Checks the bytes from `at` on, which begin with a flag.
  Check check(uint16_t at) {
    const uint8_t* frame = buffer_ + at;
    const uint16_t size = size_ - at;
    const bool is_long = frame[0] == kFlagLong;
    header_size_ = is_long ? 5 : 4;
    if (size < header_size_ - 2) return Check::Incomplete;
    data_size_ = frame[1];
    if (is_long) data_size_ |= static_cast<uint16_t>(frame[2]) << 8;
    if (is_long ? data_size_ < 255 : data_size_ == 255) return Check::NoFrame;
    if (data_size_ > MaxData) return Check::TooLong;
    if (size < header_size_ + 1) return Check::Incomplete;
    // The environment request is documented with Datelen 2 and yet without DATE.
    if (!is_long && data_size_ == 2 && frame[2] == kCmdFunction && frame[3] == kFunctionEnvironment &&
        checksum_fits(frame, 4)) {
      data_size_ = 0;
      frame_size_ = 5;
      return Check::Complete;
    }
    frame_size_ = header_size_ + data_size_ + 1;
    if (size < frame_size_) return Check::Incomplete;
    return checksum_fits(frame, frame_size_ - 1) ? Check::Complete : Check::ChecksumError;
  }

  static bool checksum_fits(const uint8_t* frame, uint16_t at) {
    uint8_t checksum = 0;
    for (uint16_t i = 0; i < at; ++i) checksum ^= frame[i];
    return checksum == frame[at];
  }

  void execute() {
    const uint8_t cmd1 = buffer_[header_size_ - 2];
    const uint8_t cmd2 = buffer_[header_size_ - 1];
    const uint8_t* data = buffer_ + header_size_;
    if (cmd1 == kCmdSync) {
      synchronised_ = true;
      send(kCmdSync, 0, 0);
    } else if (!synchronised_) {
      reply_invalid(kInvalidNotSynchronised);
    } else if (cmd1 == kCmdEcho) {
      send(kCmdEcho, data, data_size_);
    } else if (cmd1 == kCmdFunction) {
      reply(handler_.request(cmd2, data, data_size_));
    } else {
      reply(BusResult::failed(kErrorUnsupported));
    }
  }

  void reply(const BusResult& result) {
    if (result.outcome == BusResult::Ok) {
      send(kReplyOk, result.data, result.size);
    } else if (result.outcome == BusResult::Error) {
      const uint8_t data[2] = {static_cast<uint8_t>(result.error), static_cast<uint8_t>(result.error >> 8)};
      send(kReplyError, data, 2);
    } else {
      pending_ = true;
    }
  }

  void reply_invalid(uint8_t code) { send(kReplyInvalid, &code, 1); }

  void send(uint8_t cmd1, const uint8_t* data, uint16_t size) {
    uint8_t header[4];
    uint8_t length = 0;
    header[length++] = size < 255 ? kFlagStandard : kFlagLong;
    header[length++] = static_cast<uint8_t>(size);
    if (size >= 255) header[length++] = static_cast<uint8_t>(size >> 8);
    header[length++] = cmd1;
    uint8_t checksum = 0;
    for (uint8_t i = 0; i < length; ++i) checksum ^= header[i];
    for (uint16_t i = 0; i < size; ++i) checksum ^= data[i];
    sink_(static_cast<const uint8_t*>(header), length);
    if (size > 0) sink_(data, size);
    sink_(static_cast<const uint8_t*>(&checksum), 1);
  }

  void note_invalid(uint8_t code) {
    if (invalid_ == 0) invalid_ = code;
  }

  void drop_to_flag() {
    uint16_t count = 1;
    while (count < size_ && buffer_[count] != kFlagStandard && buffer_[count] != kFlagLong) ++count;
    counters.garbage_bytes += count;
    drop(count);
  }

  void drop(uint16_t count) {
    next_frame_ = true;
    size_ -= count;
    memmove(buffer_, buffer_ + count, size_);
  }

  Sink sink_;
  BusHandler& handler_;
  uint32_t frame_timeout_ms_;
  uint32_t last_byte_ms_ = 0;
  uint32_t begun_ms_ = 0;  // the incomplete frame
  uint16_t size_ = 0;
  uint16_t whole_ = 0;  // while a function is pending: the number of bytes that have been checked; else 0
  // Of the last frame in check():
  uint16_t header_size_ = 0;
  uint16_t data_size_ = 0;
  uint16_t frame_size_ = 0;
  bool synchronised_ = false;
  bool pending_ = false;
  bool next_frame_ = false;  // the incomplete frame is another one than in the last poll()
  uint8_t requests_left_ = kRequestsAtOnce;  // that may be executed before the next poll()
  uint8_t invalid_ = 0;  // the INVALID code that has still to be sent
  uint8_t buffer_[kBufferSize];  // last: an AVR's instructions reach the 63 bytes behind a pointer
};

}  // namespace serial_communication

#endif
