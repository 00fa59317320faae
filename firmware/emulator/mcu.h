// The emulated ATmega328P: libsimavr behind a small interface, with a UART at wire speed.

#ifndef EMULATOR_MCU_H
#define EMULATOR_MCU_H

#include <cstdint>
#include <deque>
#include <functional>
#include <map>
#include <string>
#include <utility>
#include <vector>

struct avr_t;
struct avr_uart_t;
struct avr_twi_t;
struct avr_irq_t;

// A device on the I2C bus.
class I2cDevice {
 public:
  virtual ~I2cDevice() {}
  // Addressed for a read or a write; false: the address is not acknowledged.
  virtual bool start(bool read) = 0;
  virtual void write(uint8_t byte) = 0;
  virtual uint8_t read() = 0;
  virtual void power_on() = 0;
};

struct SentByte {
  double seconds;  // when its stop bit ended
  uint8_t byte;
};

class Mcu {
 public:
  // bootloader: a file in Intel HEX that runs first after each reset; empty: none.
  // Throws std::runtime_error when a file cannot be loaded.
  Mcu(const std::string& elf, unsigned baud, const std::string& bootloader = "");
  ~Mcu();
  Mcu(const Mcu&) = delete;

  uint64_t cycles() const;
  uint64_t frequency() const;
  double seconds() const { return double(cycles()) / frequency(); }

  // Runs until this cycle, or a few more. False: the program has crashed or stopped.
  bool run_until(uint64_t cycle);

  void reset();
  // As reset(), but the RAM has random content and the I2C devices are reset. The EEPROM is kept.
  void power_cycle();
  // As when the port of a real Nano is opened: a reset, then a second in the bootloader with all pins floating;
  // the bootloader if there is one.
  void dtr();
  bool has_bootloader() const;
  // The program enters an endless loop with its interrupts disabled.
  void crash();
  double crash_seconds() const { return crash_seconds_; }  // when it did
  // Stalls the program for this time in seconds, but not its interrupts.
  void stall(double seconds);
  unsigned watchdog_resets() const { return watchdog_resets_; }

  // A device holds SDA low for this number of clocks; 0: none does.
  void hold_sda(unsigned clocks);
  unsigned sda_clocks() const { return sda_clocks_; }
  // A device holds SCL low.
  void hold_scl(bool low);
  bool scl_held() const { return scl_held_; }

  // Bytes on their way to the board: they arrive one by one at wire speed.
  void uart_receive(const uint8_t* bytes, size_t size);
  size_t uart_backlog() const { return uart_in_.size(); }
  // Takes the bytes whose stop bit the board has sent by now.
  std::vector<SentByte> uart_take_sent();
  // Emulated seconds at which the last byte had arrived.
  double uart_last_received() const { return uart_last_received_; }
  void set_baud(unsigned baud) { cycles_per_wire_byte_ = 10.0 * frequency() / baud; }
  uint64_t uart_received() const { return uart_received_; }
  uint64_t uart_overruns() const { return uart_overruns_; }

  void attach_i2c(uint8_t address, I2cDevice* device) { i2c_devices_[address] = device; }

  // Returns the voltage at an ADC channel.
  std::function<double(int channel)> adc_volts;
  // Called after each reset, when all outputs have changed without being written.
  std::function<void()> after_reset;

  uint8_t data(uint16_t address) const;
  void on_write(uint16_t address, std::function<void()> callback);
  void on_output_pin(char port, int bit, std::function<void(bool level)> callback);
  bool output_pin(char port, int bit) const;
  // Whether the program drives it neither high nor low.
  bool input_pin(char port, int bit) const;
  void drive_pin(char port, int bit, bool level);
  // Nothing drives it from outside any longer: a pull-up that the program has enabled makes it high.
  void release_pin(char port, int bit);
  // The level at a pin, whoever drives it.
  bool pin_level(char port, int bit) const;
  // Calls back every `cycles`, across resets.
  void every(uint64_t cycles, std::function<void()> callback);

  std::vector<uint8_t> eeprom() const;
  void set_eeprom(const std::vector<uint8_t>& content);

 private:
  struct Hook {
    uint64_t period;  // cycles; 0: not a timer
    std::function<void()> on_event;
    std::function<void(bool)> on_level;
  };

  struct DrivenPins {
    uint8_t mask = 0;
    uint8_t levels = 0;
  };

  void load_bootloader(const std::string& path);
  void apply_driven_pins(char port, const DrivenPins& pins);
  bool pull_up(char port, int bit) const;
  void after_cpu_reset();
  void hold_program();
  void start_timers();
  void start_timer(Hook& hook);
  void i2c_message(uint32_t value);
  void twcr_write(uint16_t address, uint8_t value);
  bool i2c_lines_free() const { return sda_clocks_ == 0 && !scl_held_; }
  void i2c_lines_changed();
  void adc_trigger(uint32_t value);
  uint64_t feed_uart(uint64_t when);
  void uart_output(uint8_t byte);
  double wire_bit() const { return cycles_per_wire_byte_ / 10; }

  avr_t* avr_;
  void (*run_)(avr_t*);  // avr_->run, but while the watchdog resets the chip
  uint64_t boot_end_ = 0;
  uint64_t stall_end_ = 0;
  bool program_held_ = false;
  unsigned watchdog_resets_ = 0;
  double crash_seconds_ = 0;

  avr_uart_t* uart_;
  avr_irq_t* uart_input_;
  avr_irq_t* i2c_input_;
  avr_irq_t* adc_;
  std::map<char, DrivenPins> driven_pins_;  // by port
  std::deque<Hook> hooks_;  // a deque keeps their addresses

  double cycles_per_wire_byte_;
  std::deque<uint8_t> uart_in_;
  double uart_line_free_ = 0;  // cycle at which the next byte from the wire may start
  bool uart_feeding_ = false;
  std::deque<std::pair<uint64_t, uint8_t>> uart_out_;
  uint64_t uart_out_free_ = 0;
  double uart_last_received_ = 0;
  uint64_t uart_received_ = 0;
  uint64_t uart_overruns_ = 0;

  std::map<uint8_t, I2cDevice*> i2c_devices_;
  I2cDevice* i2c_selected_ = nullptr;
  bool i2c_sending_ = false;  // the device, with more to come
  avr_twi_t* twi_;
  void (*twi_write_)(avr_t*, uint16_t, uint8_t, void*);
  void* twi_parameter_;
  bool twi_waiting_ = false;  // for the lines
  unsigned sda_clocks_ = 0;
  bool scl_held_ = false;
};

#endif
