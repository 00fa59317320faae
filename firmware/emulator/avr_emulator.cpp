// avr_emulator: runs a board's firmware in an emulated ATmega328P with a small world connected to it, which a control
// socket reads and changes. In real time, with its UART on a pty or tty; or in lock step, where a client of that socket
// moves its time. See firmware/README.md.

#include <poll.h>
#include <signal.h>
#include <string.h>
#include <sys/prctl.h>
#include <time.h>
#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iterator>
#include <memory>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

#include "control.h"
#include "mcu.h"
#include "serial_end.h"
#include "world.h"

namespace {

// The emulator runs ahead of real time by this much, then waits.
const double kSlice = 0.001;
// An emulator that was stalled catches up this much at most. The rest of a longer stall is left out of the
// emulated time. Otherwise the board would see 30 ms without a heartbeat that the wire never had.
const double kCatchUp = 0.008;
// The chip's UART never holds more than this many bytes back on the wire; the rest waits in the tty.
const size_t kWireBacklog = 64;
const double kEepromPeriod = 0.2;
const double kReopenPeriod = 0.1;

volatile sig_atomic_t stop_requested = 0;
void request_stop(int) { stop_requested = 1; }

double clock_seconds(clockid_t clock) {
  timespec now;
  clock_gettime(clock, &now);
  return now.tv_sec + now.tv_nsec * 1e-9;
}

struct Options {
  std::string elf, world, link, port, control, eeprom, bootloader;
  bool still = false;
  bool lock_step = false;
  double boot = 0;
  unsigned baud = 115200;
};

const char kUsage[] =
    "usage: avr_emulator --world car|ctrl|range|diff|pins [options] ELF\n"
    "  --link PATH     UART on a new pty, with a symbolic link to it at PATH\n"
    "  --port PATH     UART on an existing tty, opened again when it vanishes\n"
    "  --control PATH  Unix socket of the control channel\n"
    "  --eeprom FILE   keep the EEPROM in FILE\n"
    "  --still         nothing in the world moves by itself\n"
    "  --bootloader HEX  each opening of the pty starts this bootloader, as of a real Nano\n"
    "  --baud N        speed of the wire towards the board (115200)\n"
    "  --lock-step     the UART is on the control channel, too: each client has a copy of the board as it is when it\n"
    "                  connects, whose time moves only in its commands `run`\n"
    "  --boot SECONDS  with --lock-step: the first client connects after so many emulated seconds\n"
    "Arguments like __name:=x, which roslaunch adds, are ignored.\n";

Options parse(int argc, char** argv) {
  Options options;
  for (int i = 1; i < argc; ++i) {
    const std::string argument = argv[i];
    const auto value = [&]() -> std::string {
      if (i + 1 >= argc) throw std::runtime_error(argument + " needs a value");
      return argv[++i];
    };
    if (argument.compare(0, 2, "__") == 0 && argument.find(":=") != std::string::npos) continue;
    if (argument == "--world") {
      options.world = value();
    } else if (argument == "--link") {
      options.link = value();
    } else if (argument == "--port") {
      options.port = value();
    } else if (argument == "--control") {
      options.control = value();
    } else if (argument == "--eeprom") {
      options.eeprom = value();
    } else if (argument == "--bootloader") {
      options.bootloader = value();
    } else if (argument == "--still") {
      options.still = true;
    } else if (argument == "--lock-step") {
      options.lock_step = true;
    } else if (argument == "--boot") {
      options.boot = strtod(value().c_str(), nullptr);
    } else if (argument == "--baud") {
      options.baud = unsigned(strtoul(value().c_str(), nullptr, 10));
    } else if (argument == "--help" || argument == "-h") {
      fputs(kUsage, stdout);
      exit(0);
    } else if (argument.compare(0, 1, "-") == 0 || !options.elf.empty()) {
      throw std::runtime_error("unknown argument " + argument + "; --help lists the options");
    } else {
      options.elf = argument;
    }
  }
  if (options.elf.empty()) throw std::runtime_error("no ELF file given; --help lists the options");
  if (options.baud == 0) throw std::runtime_error("--baud must be a number above 0");
  if (!options.link.empty() && !options.port.empty()) throw std::runtime_error("--link and --port exclude each other");
  if (options.lock_step && options.control.empty()) throw std::runtime_error("--lock-step needs --control");
  return options;
}

std::unique_ptr<World> make_world(const Options& options, Mcu& mcu) {
  if (options.world == "car") return make_car_world(mcu, options.still);
  if (options.world == "ctrl") return make_ctrl_world(mcu, options.still);
  if (options.world == "range") return make_range_world(mcu, options.still);
  if (options.world == "diff") return make_diff_world(mcu);
  if (options.world == "pins") return make_pins_world(mcu);
  throw std::runtime_error("--world must be car, ctrl, range, diff or pins, not \"" + options.world + "\"");
}

// The EEPROM's content in a file, written whenever it has changed.
class EepromFile {
 public:
  EepromFile(const std::string& path, Mcu& mcu) : path_(path), mcu_(mcu), saved_(mcu.eeprom()) {
    if (path_.empty()) return;
    std::ifstream file(path_, std::ios::binary);
    if (file) {
      saved_.assign(std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>());
      mcu_.set_eeprom(saved_);
      saved_ = mcu_.eeprom();
    } else if (!write()) {
      throw std::runtime_error("cannot write the EEPROM file " + path_);
    }
  }

  void save() {
    if (path_.empty()) return;
    const std::vector<uint8_t> content = mcu_.eeprom();
    if (content == saved_) return;
    saved_ = content;
    if (!write()) fprintf(stderr, "avr_emulator: cannot write the EEPROM file %s\n", path_.c_str());
  }

 private:
  bool write() const {
    std::ofstream file(path_, std::ios::binary | std::ios::trunc);
    file.write(reinterpret_cast<const char*>(saved_.data()), std::streamsize(saved_.size()));
    return bool(file.flush());
  }

  std::string path_;
  Mcu& mcu_;
  std::vector<uint8_t> saved_;
};

// The chip and its world, and the commands of the control channel that both modes have.
class Board {
 public:
  explicit Board(const Options& options)
      : mcu_(options.elf, options.baud, options.bootloader), world_(make_world(options, mcu_)) {
    Values& values = world_->values;
    values.reading("time", [this] { return mcu_.seconds(); });
    values.reading("cycles", [this] { return double(mcu_.cycles()); });
    values.reading("last_rx_time", [this] { return mcu_.uart_last_received(); });
    values.reading("rx_bytes", [this] { return double(mcu_.uart_received()); });
    values.reading("rx_overruns", [this] { return double(mcu_.uart_overruns()); });
    values.reading("last_tx_time", [this] { return last_sent_; });
    values.reading("tx_bytes", [this] { return double(sent_bytes_); });
    values.reading("crash_time", [this] { return mcu_.crash_seconds(); });
    values.reading("watchdog_resets", [this] { return double(mcu_.watchdog_resets()); });
    values.variable("sda_stuck", [this] { return double(mcu_.sda_clocks()); },
                    [this](double clocks) { mcu_.hold_sda(unsigned(std::fmax(clocks, 0))); });
    values.variable("scl_stuck", [this] { return double(mcu_.scl_held()); },
                    [this](double low) { mcu_.hold_scl(low != 0); });
  }
  virtual ~Board() {}

 protected:
  virtual std::string answer(const std::string& line) {
    std::istringstream words(line);
    std::string command, name;
    words >> command >> name;
    Values& values = world_->values;
    if (command == "get") {
      if (!values.has(name)) return "error: no value named \"" + name + "\"; list names them";
      char text[40];
      snprintf(text, sizeof text, "%.10g", values.get(name));
      return text;
    }
    if (command == "set") {
      double value;
      if (!(words >> value) || !std::isfinite(value)) return "error: set NAME NUMBER";
      if (!values.has(name)) return "error: no value named \"" + name + "\"; list names them";
      if (!values.set(name, value)) return "error: \"" + name + "\" can only be read";
      return "ok";
    }
    if (command == "history") {
      const std::string history = values.history(name);
      return history.empty() ? "error: \"" + name + "\" has no history" : history;
    }
    if (command == "list") return values.names();
    if (command == "stall") {
      double seconds;
      if (!(std::istringstream(name) >> seconds) || !(seconds >= 0 && seconds < 1e6)) return "error: stall SECONDS";
      mcu_.stall(seconds);
      return "ok";
    }
    if (command == "reset") {
      mcu_.reset();
    } else if (command == "power_cycle") {
      mcu_.power_cycle();
    } else if (command == "dtr") {
      mcu_.dtr();
    } else if (command == "crash") {
      mcu_.crash();
    } else if (command == "quit") {
      stop_requested = 1;
    } else {
      return "error: commands are get, set, history, list, reset, power_cycle, dtr, crash, stall, quit; in lock step "
             "also run and send";
    }
    return "ok";
  }

  // False: the program has stopped, and no bootloader waits for another one.
  bool run_until(uint64_t cycle) {
    if (mcu_.run_until(cycle)) return true;
    if (!mcu_.has_bootloader()) return false;
    mcu_.crash();  // as half a program does after an upload that ended: until the next one
    return true;
  }

  std::vector<SentByte> take_sent() {
    std::vector<SentByte> sent = mcu_.uart_take_sent();
    sent_bytes_ += sent.size();
    if (!sent.empty()) last_sent_ = sent.back().seconds;
    return sent;
  }

  Mcu mcu_;
  std::unique_ptr<World> world_;

 private:
  uint64_t sent_bytes_ = 0;
  double last_sent_ = 0;
};

class RealTimeBoard : public Board {
 public:
  explicit RealTimeBoard(const Options& options)
      : Board(options),
        eeprom_(options.eeprom, mcu_),
        serial_(options.port.empty() ? SerialEnd::make_pty(options.link) : SerialEnd::use_port(options.port)) {
    if (!options.control.empty()) {
      control_.reset(new Control(options.control, [this](const std::string& line) { return answer(line); }, false));
    }
    world_->values.reading("tx_flushes", [this] { return double(serial_.flushes()); });
    printf("avr_emulator: %s on %s\n", options.elf.c_str(), serial_.name().c_str());
    fflush(stdout);
  }

  // Runs until a signal or `quit`; returns the exit status.
  int run() {
    wall_start_ = origin_ = clock_seconds(CLOCK_MONOTONIC);
    double next_chores = 0;
    int status = 0;
    while (!stop_requested) {
      if (mcu_.has_bootloader()) act_as_adapter();
      if (!run_until(mcu_.cycles() + uint64_t(kSlice * mcu_.frequency()))) {
        fprintf(stderr, "avr_emulator: the program stopped at %.6f s\n", mcu_.seconds());
        status = 1;
        break;
      }
      std::string sent;
      for (const SentByte& each : take_sent()) sent.push_back(char(each.byte));
      serial_.write(sent);
      if (mcu_.seconds() >= next_chores) {
        next_chores = mcu_.seconds() + std::min(kEepromPeriod, kReopenPeriod);
        eeprom_.save();
        serial_.reopen();
      }
      wait_for_wall_clock();
    }
    eeprom_.save();
    printf("avr_emulator: %s\n", speed().c_str());
    return status;
  }

 protected:
  std::string answer(const std::string& line) override {
    if (line == "get speed") return speed();
    if (line != "get origin") return Board::answer(line);
    char text[40];
    snprintf(text, sizeof text, "%.6f", origin_);
    return text;
  }

 private:
  // What the USB adapter of a Nano does: opening its port resets the chip, and the wire has the speed that is set.
  void act_as_adapter() {
    if (serial_.was_opened()) mcu_.dtr();
    const unsigned baud = serial_.baud();
    if (baud != 0) mcu_.set_baud(baud);
  }

  // Waits for at most so many seconds, and handles what arrives meanwhile.
  void serve(double left) {
    timespec timeout = {0, left > 0 ? long(left * 1e9) : 0};
    descriptors_.clear();
    const bool read_serial = serial_.descriptor() >= 0 && mcu_.uart_backlog() < kWireBacklog;
    if (read_serial) descriptors_.push_back(pollfd{serial_.descriptor(), POLLIN, 0});
    if (control_) control_->add_to(descriptors_);
    if (ppoll(descriptors_.data(), descriptors_.size(), &timeout, nullptr) <= 0) return;
    if (read_serial && descriptors_[0].revents != 0) {
      uint8_t bytes[kWireBacklog];
      mcu_.uart_receive(bytes, serial_.read(bytes, sizeof bytes));
    }
    if (control_) {
      for (size_t i = read_serial ? 1 : 0; i < descriptors_.size(); ++i) control_->handle(descriptors_[i]);
    }
  }

  void wait_for_wall_clock() {
    for (;;) {
      const double deadline = origin_ + mcu_.seconds();
      serve(deadline - clock_seconds(CLOCK_MONOTONIC));
      const double late = clock_seconds(CLOCK_MONOTONIC) - deadline;
      if (late > kCatchUp) {
        origin_ += late;
        left_out_ += late;
      }
      if (late >= 0 || stop_requested) return;
    }
  }

  std::string speed() const {
    const double wall = clock_seconds(CLOCK_MONOTONIC) - wall_start_;
    const double cpu = clock_seconds(CLOCK_PROCESS_CPUTIME_ID);
    char text[160];
    snprintf(text, sizeof text, "emulated %.3f s in %.3f s (speed %.4f), CPU %.3f s (%.1f %%), left out %.3f s",
             mcu_.seconds(), wall, mcu_.seconds() / wall, cpu, 100 * cpu / wall, left_out_);
    return text;
  }

  EepromFile eeprom_;
  SerialEnd serial_;
  std::unique_ptr<Control> control_;
  std::vector<pollfd> descriptors_;
  double wall_start_ = 0;
  double origin_ = 0;  // the wall clock at emulated second 0
  double left_out_ = 0;
};

// Nothing here waits for a clock: a client that is slow only makes the same take longer.
class LockStepBoard : public Board {
 public:
  explicit LockStepBoard(const Options& options)
      : Board(options),
        control_(options.control, [this](const std::string& line) { return answer(line); }, true) {
    prctl(PR_SET_PDEATHSIG, SIGTERM);  // whoever started it was killed
    signal(SIGCHLD, SIG_IGN);
    if (!run_until(uint64_t(options.boot * mcu_.frequency()))) throw std::runtime_error("the program has stopped");
    printf("avr_emulator: %s on %s\n", options.elf.c_str(), options.control.c_str());
    fflush(stdout);
  }

  int run() {
    std::vector<pollfd> descriptors;
    while (!stop_requested && !control_.is_over()) {
      descriptors.clear();
      control_.add_to(descriptors);
      if (poll(descriptors.data(), descriptors.size(), -1) <= 0) continue;
      for (const pollfd& descriptor : descriptors) control_.handle(descriptor);
    }
    return 0;
  }

 protected:
  // run SECONDS: the board runs until that emulated second. The answer is its time then, and SECONDS:HEX of each byte
  // whose stop bit it has sent since the last one. send HEX: bytes follow on the line to the board.
  std::string answer(const std::string& line) override {
    std::istringstream words(line);
    std::string command, argument;
    words >> command >> argument;
    if (command == "send") {
      std::vector<uint8_t> bytes;
      unsigned byte;
      for (size_t at = 0; at < argument.size(); at += 2) {
        if (sscanf(argument.c_str() + at, "%2x", &byte) != 1) return "error: send HEX";
        bytes.push_back(uint8_t(byte));
      }
      mcu_.uart_receive(bytes.data(), bytes.size());
      return "ok";
    }
    if (command != "run") return Board::answer(line);
    const double end = strtod(argument.c_str(), nullptr);
    if (!run_until(uint64_t(end * mcu_.frequency()))) return "error: the program has stopped";
    char text[32];
    snprintf(text, sizeof text, "%.7f", mcu_.seconds());
    std::string all = text;
    for (const SentByte& each : take_sent()) {
      snprintf(text, sizeof text, " %.6f:%02x", each.seconds, each.byte);
      all += text;
    }
    return all;
  }

 private:
  Control control_;
};

}  // namespace

int main(int argc, char** argv) {
  struct sigaction action;
  memset(&action, 0, sizeof action);
  action.sa_handler = request_stop;
  sigaction(SIGTERM, &action, nullptr);
  sigaction(SIGINT, &action, nullptr);
  try {
    const Options options = parse(argc, argv);
    return options.lock_step ? LockStepBoard(options).run() : RealTimeBoard(options).run();
  } catch (const std::exception& error) {
    fprintf(stderr, "avr_emulator: %s\n", error.what());
    return 1;
  }
}
