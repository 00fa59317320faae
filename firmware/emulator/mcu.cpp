// See mcu.h. libsimavr 1.6 differs from the chip in these points, which are corrected here:
//
// - Its UART counts a parity bit that 8N1 does not have. The time of a byte is corrected after each
//   write to UBRR0.
// - Its UART outputs a byte when the program writes it. Here the byte is sent when its stop bit would end.
// - Its UART accepts input at any speed, into a buffer of 64 bytes. Bytes are fed at wire speed. A byte that
//   arrives while two bytes and the shift register are full is lost and counted, as on the chip.
// - By default it sleeps a microsecond on each read of UCSR0A and prints the output. Both are disabled.
// - Its ADC computes volts * 1023 / reference, the chip 1024. The voltage is scaled to compensate.
// - Its sleep calls usleep(), which loses time at every call. In real time main() waits instead.
// - It polls a low pin of a level-triggered INT each cycle, even if disabled, and INT1 (pin 3) is such a pin
//   after a reset, so the chip would never sleep. The polling is disabled.
// - A reset removes all its cycle timers; they are started again. A reset also forgets the levels of input
//   pins, but a pin ignores a level that it had before, so each driven pin first gets the other level.
// - Each write to a port applies the pull-ups to its input pins again, even to pins that are driven from
//   outside. So every driven level is set as the external level, too.
// - Its TWI takes an address for a data byte, since TWDR was written before it, and leaves TWINT set
//   when the program clears it. Both are corrected at each write to TWCR. START takes no time, a clock
//   a microsecond. Its bus cannot hold a line low; while a line is held, writes to TWCR are delayed here.
// - A reset by its watchdog removes all cycle timers, too.
// - Its UART samples without error. At another baud rate the bits that a chip would sample are computed here.

#include "mcu.h"

#include <cmath>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <stdexcept>

extern "C" {
#include <avr_adc.h>
#include <avr_eeprom.h>
#include <avr_extint.h>
#include <avr_ioport.h>
#include <avr_twi.h>
#include <avr_uart.h>
#include <sim_avr.h>
#include <sim_cycle_timers.h>
#include <sim_elf.h>
#include <sim_interrupts.h>
#include <sim_io.h>
}

namespace {

const uint32_t kFrequency = 16000000;
const uint16_t kUbrr0l = 0xC4;
const uint16_t kTwcr = 0xBC;
const uint16_t kDdrc = 0x27;
const uint8_t kTwint = 0x80, kTwsta = 0x20, kTwsto = 0x10, kTwen = 0x04;
const char kI2cPort = 'C';
const int kSdaBit = 4, kSclBit = 5;
const unsigned kBitsOfAByte = 8;
const double kBootSeconds = 1;
const double kVcc = 5.0;
// How many cycles the core may run between two checks of its timers.
const avr_cycle_count_t kRunCycleLimit = 64;

void keep_pace_elsewhere(avr_t*, avr_cycle_count_t) {}

// The byte that a UART reads if its bits are `ratio` times as long as the sender's. Each bit is sampled in its
// middle, counted from the edge of the start bit. The line is idle after the stop bit.
uint8_t sampled(uint8_t byte, double ratio) {
  const unsigned wire = ~0u << 9 | unsigned(byte) << 1;  // from the start bit, 0, to the stop bit
  uint8_t read = 0;
  for (int bit = 0; bit < 8; ++bit) read |= uint8_t((wire >> int((bit + 1.5) * ratio) & 1) << bit);
  return read;
}

void log_errors(avr_t*, const int level, const char* format, va_list arguments) {
  if (level == LOG_ERROR) vfprintf(stderr, format, arguments);
}

}  // namespace

Mcu::Mcu(const std::string& elf, unsigned baud, const std::string& bootloader)
    : cycles_per_wire_byte_(10.0 * kFrequency / baud) {
  avr_global_logger_set(log_errors);
  elf_firmware_t firmware;
  memset(&firmware, 0, sizeof firmware);
  if (elf_read_firmware(elf.c_str(), &firmware) != 0) {
    throw std::runtime_error("cannot load the ELF file " + elf);
  }
  avr_ = avr_make_mcu_by_name("atmega328p");
  if (avr_ == nullptr) throw std::runtime_error("libsimavr does not know the atmega328p");
  avr_init(avr_);
  avr_->frequency = kFrequency;
  avr_->vcc = avr_->avcc = avr_->aref = uint32_t(kVcc * 1000);
  firmware.frequency = kFrequency;
  firmware.vcc = firmware.avcc = firmware.aref = uint32_t(kVcc * 1000);
  avr_load_firmware(avr_, &firmware);
  if (!bootloader.empty()) load_bootloader(bootloader);
  avr_->sleep = keep_pace_elsewhere;
  run_ = avr_->run;

  uart_ = nullptr;
  twi_ = nullptr;
  for (avr_io_t* io = avr_->io_port; io != nullptr; io = io->next) {
    if (strcmp(io->kind, "uart") == 0) uart_ = reinterpret_cast<avr_uart_t*>(io);
    if (strcmp(io->kind, "twi") == 0) twi_ = reinterpret_cast<avr_twi_t*>(io);
  }
  uint32_t flags = 0;
  avr_ioctl(avr_, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
  uart_input_ = avr_io_getirq(avr_, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
  avr_irq_register_notify(
      avr_io_getirq(avr_, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT),
      [](avr_irq_t*, uint32_t value, void* self) { static_cast<Mcu*>(self)->uart_output(uint8_t(value)); }, this);
  on_write(kUbrr0l, [this] { uart_->cycles_per_byte = uart_->cycles_per_byte * 10 / 11; });

  i2c_input_ = avr_io_getirq(avr_, AVR_IOCTL_TWI_GETIRQ(0), TWI_IRQ_INPUT);
  avr_irq_register_notify(
      avr_io_getirq(avr_, AVR_IOCTL_TWI_GETIRQ(0), TWI_IRQ_OUTPUT),
      [](avr_irq_t*, uint32_t value, void* self) { static_cast<Mcu*>(self)->i2c_message(value); }, this);

  auto& twcr = avr_->io[AVR_DATA_TO_IO(kTwcr)].w;
  twi_write_ = twcr.c;
  twi_parameter_ = twcr.param;
  twcr.c = [](avr_t*, avr_io_addr_t address, uint8_t value, void* self) {
    static_cast<Mcu*>(self)->twcr_write(address, value);
  };
  twcr.param = this;
  on_output_pin(kI2cPort, kSclBit, [this](bool high) {
    const bool driven = avr_->data[kDdrc] >> kSclBit & 1;
    if (!high && driven && !scl_held_ && sda_clocks_ > 0) hold_sda(sda_clocks_ - 1);
  });

  adc_ = avr_io_getirq(avr_, AVR_IOCTL_ADC_GETIRQ, ADC_IRQ_ADC0);
  avr_irq_register_notify(
      avr_io_getirq(avr_, AVR_IOCTL_ADC_GETIRQ, ADC_IRQ_OUT_TRIGGER),
      [](avr_irq_t*, uint32_t value, void* self) { static_cast<Mcu*>(self)->adc_trigger(value); }, this);
  start_timers();
  i2c_lines_changed();
}

// simavr's own reader stops at records of type 3, which every bootloader of Arduino has. A file that goes beyond the
// flash is refused: Debian's own optiboot_atmega328.hex is 20 bytes too long.
void Mcu::load_bootloader(const std::string& path) {
  std::ifstream file(path);
  std::string line;
  while (std::getline(file, line)) {
    unsigned size, address, type, byte;
    if (sscanf(line.c_str(), ":%2x%4x%2x", &size, &address, &type) != 3 || type != 0) continue;
    if (avr_->reset_pc == 0) avr_->pc = avr_->reset_pc = address;
    if (address + size > avr_->flashend + 1) throw std::runtime_error("too long for the flash: " + path);
    for (unsigned i = 0; i < size && sscanf(line.c_str() + 9 + 2 * i, "%2x", &byte) == 1; ++i) {
      avr_->flash[address + i] = uint8_t(byte);
    }
  }
  if (avr_->reset_pc == 0) throw std::runtime_error("cannot load the bootloader " + path);
  avr_->codeend = avr_->flashend;
}

bool Mcu::has_bootloader() const { return avr_->reset_pc != 0; }

Mcu::~Mcu() { avr_terminate(avr_); }

uint64_t Mcu::cycles() const { return avr_->cycle; }
uint64_t Mcu::frequency() const { return avr_->frequency; }
uint8_t Mcu::data(uint16_t address) const { return avr_->data[address]; }

bool Mcu::run_until(uint64_t cycle) {
  while (avr_->cycle < cycle) {
    hold_program();
    const bool resetting = avr_->run != run_;
    const int state = avr_run(avr_);
    if (resetting) {
      ++watchdog_resets_;
      after_cpu_reset();
    }
    if (state == cpu_Crashed || state == cpu_Done) return false;
  }
  return true;
}

// In the bootloader and while stalled the CPU sleeps at its current instruction. Interrupts wake it, and it runs
// on one instruction at a time, until it is back in the program proper with interrupts on.
void Mcu::hold_program() {
  const bool booting = avr_->cycle < boot_end_;
  if (!booting && avr_->cycle >= stall_end_) {
    if (program_held_) {
      program_held_ = false;
      avr_->run_cycle_limit = kRunCycleLimit;
      if (boot_end_ != 0) avr_->sreg[S_I] = 0;
      boot_end_ = stall_end_ = 0;
      avr_->state = cpu_Running;
    }
    return;
  }
  program_held_ = true;
  avr_->run_cycle_limit = 1;
  if (booting) avr_->sreg[S_I] = 1;  // it would not sleep without
  const bool interrupted = avr_->interrupts.running_ptr != 0 || avr_->interrupt_state != 0 || !avr_->sreg[S_I];
  if (!interrupted) avr_->state = cpu_Sleeping;
}

void Mcu::reset() {
  avr_reset(avr_);
  after_cpu_reset();
}

void Mcu::after_cpu_reset() {
  avr_->state = cpu_Running;
  boot_end_ = stall_end_ = 0;
  program_held_ = false;
  uart_in_.clear();
  uart_feeding_ = false;
  // A device that was sending still has the rest of its byte to send; the chip does not know.
  if (i2c_sending_) hold_sda(kBitsOfAByte);
  i2c_selected_ = nullptr;
  i2c_sending_ = false;
  start_timers();
  for (const auto& port : driven_pins_) {
    apply_driven_pins(port.first, port.second);
    for (int bit = 0; bit < 8; ++bit) {
      if (!(port.second.mask >> bit & 1)) continue;
      avr_irq_t* pin = avr_io_getirq(avr_, uint32_t(AVR_IOCTL_IOPORT_GETIRQ(port.first)), bit);
      const bool level = port.second.levels >> bit & 1;
      avr_raise_irq(pin, !level);
      avr_raise_irq(pin, level);
    }
  }
  if (after_reset) after_reset();
}

void Mcu::power_cycle() {
  for (auto& device : i2c_devices_) device.second->power_on();
  i2c_sending_ = false;
  reset();
  hold_sda(0);
  uint32_t noise = 1;
  for (uint32_t address = avr_->ioend + 1u; address <= avr_->ramend; ++address) {
    noise = noise * 1664525 + 1013904223;
    avr_->data[address] = uint8_t(noise >> 24);
  }
}

void Mcu::dtr() {
  reset();
  if (has_bootloader()) {
    avr_regbit_clear(avr_, avr_->reset_flags.porf);
    avr_regbit_set(avr_, avr_->reset_flags.extrf);  // without it a bootloader starts the program at once
    return;
  }
  boot_end_ = avr_->cycle + uint64_t(kBootSeconds * kFrequency);
}

void Mcu::crash() {
  const uint32_t loop = avr_->flashend - 1;  // rjmp .-2
  avr_->flash[loop] = 0xFF;
  avr_->flash[loop + 1] = 0xCF;
  avr_->pc = loop;
  crash_seconds_ = seconds();
  avr_->sreg[S_I] = 0;
  avr_->state = cpu_Running;
}

void Mcu::stall(double seconds) { stall_end_ = avr_->cycle + uint64_t(seconds * kFrequency); }

void Mcu::hold_sda(unsigned clocks) {
  sda_clocks_ = clocks;
  i2c_lines_changed();
}

void Mcu::hold_scl(bool low) {
  scl_held_ = low;
  i2c_lines_changed();
}

void Mcu::i2c_lines_changed() {
  drive_pin(kI2cPort, kSdaBit, sda_clocks_ == 0);
  drive_pin(kI2cPort, kSclBit, !scl_held_);
  if (!twi_waiting_ || !i2c_lines_free()) return;
  twi_waiting_ = false;
  const uint8_t value = avr_->data[kTwcr];
  avr_->data[kTwcr] = uint8_t(value & ~(kTwsta | kTwsto));
  twcr_write(kTwcr, value | kTwint);
}

void Mcu::twcr_write(uint16_t address, uint8_t value) {
  twi_waiting_ = (value & kTwen) && (value & kTwint) && !i2c_lines_free();
  if (twi_waiting_) {
    avr_->data[address] = uint8_t(value & ~kTwint);
    return;
  }
  if (!(twi_->state & TWI_COND_ADDR)) twi_->state &= uint8_t(~TWI_COND_WRITE);
  twi_write_(avr_, address, value, twi_parameter_);
  if (value & kTwint) avr_->data[address] &= uint8_t(~kTwint);
}

void Mcu::start_timers() {
  avr_->run_cycle_limit = kRunCycleLimit;
  for (uint8_t interrupt : {0, 1}) avr_extint_set_strict_lvl_trig(avr_, interrupt, 0);
  for (Hook& hook : hooks_) {
    if (hook.period != 0) start_timer(hook);
  }
}

void Mcu::start_timer(Hook& hook) {
  avr_cycle_timer_register(
      avr_, hook.period,
      [](avr_t*, avr_cycle_count_t when, void* parameter) -> avr_cycle_count_t {
        Hook* timer = static_cast<Hook*>(parameter);
        timer->on_event();
        return when + timer->period;
      },
      &hook);
}

void Mcu::every(uint64_t cycles, std::function<void()> callback) {
  hooks_.push_back(Hook{cycles, std::move(callback), nullptr});
  start_timer(hooks_.back());
}

void Mcu::on_write(uint16_t address, std::function<void()> callback) {
  hooks_.push_back(Hook{0, std::move(callback), nullptr});
  avr_irq_register_notify(
      avr_iomem_getirq(avr_, address, nullptr, AVR_IOMEM_IRQ_ALL),
      [](avr_irq_t*, uint32_t, void* parameter) { static_cast<Hook*>(parameter)->on_event(); }, &hooks_.back());
}

void Mcu::on_output_pin(char port, int bit, std::function<void(bool)> callback) {
  hooks_.push_back(Hook{0, nullptr, std::move(callback)});
  avr_irq_register_notify(
      avr_io_getirq(avr_, uint32_t(AVR_IOCTL_IOPORT_GETIRQ(port)), bit),
      [](avr_irq_t*, uint32_t value, void* parameter) { static_cast<Hook*>(parameter)->on_level(value & 1); },
      &hooks_.back());
}

bool Mcu::output_pin(char port, int bit) const {
  avr_ioport_state_t state;
  if (avr_ioctl(avr_, uint32_t(AVR_IOCTL_IOPORT_GETSTATE(port)), &state) != 0) return false;
  return (state.port & state.ddr) >> bit & 1;
}

bool Mcu::input_pin(char port, int bit) const {
  avr_ioport_state_t state;
  if (avr_ioctl(avr_, uint32_t(AVR_IOCTL_IOPORT_GETSTATE(port)), &state) != 0) return false;
  return !(state.ddr >> bit & 1);
}

void Mcu::drive_pin(char port, int bit, bool level) {
  DrivenPins& pins = driven_pins_[port];
  pins.mask |= uint8_t(1 << bit);
  pins.levels = uint8_t((pins.levels & ~(1 << bit)) | level << bit);
  apply_driven_pins(port, pins);
  avr_raise_irq(avr_io_getirq(avr_, uint32_t(AVR_IOCTL_IOPORT_GETIRQ(port)), bit), level);
}

void Mcu::release_pin(char port, int bit) {
  DrivenPins& pins = driven_pins_[port];
  pins.mask &= uint8_t(~(1 << bit));
  apply_driven_pins(port, pins);
  if (!input_pin(port, bit)) return;
  avr_raise_irq(avr_io_getirq(avr_, uint32_t(AVR_IOCTL_IOPORT_GETIRQ(port)), bit), pull_up(port, bit));
}

bool Mcu::pull_up(char port, int bit) const {
  avr_ioport_state_t state;
  if (avr_ioctl(avr_, uint32_t(AVR_IOCTL_IOPORT_GETSTATE(port)), &state) != 0) return false;
  return (state.port & ~state.ddr) >> bit & 1;
}

bool Mcu::pin_level(char port, int bit) const {
  if (!input_pin(port, bit)) return output_pin(port, bit);
  const auto found = driven_pins_.find(port);
  const bool driven = found != driven_pins_.end() && found->second.mask >> bit & 1;
  return driven ? found->second.levels >> bit & 1 : pull_up(port, bit);
}

void Mcu::apply_driven_pins(char port, const DrivenPins& pins) {
  avr_ioport_external_t external;
  memset(&external, 0, sizeof external);
  external.name = (unsigned long)port & 0x7F;
  external.mask = pins.mask;
  external.value = pins.levels;
  avr_ioctl(avr_, uint32_t(AVR_IOCTL_IOPORT_SET_EXTERNAL(port)), &external);
}

// UART: from the wire into the chip. simavr makes a byte readable one byte time after it was passed,
// so it is passed at its start bit.
void Mcu::uart_receive(const uint8_t* bytes, size_t size) {
  uart_in_.insert(uart_in_.end(), bytes, bytes + size);
  if (uart_feeding_ || uart_in_.empty()) return;
  uart_feeding_ = true;
  if (uart_line_free_ < avr_->cycle + 1.0) uart_line_free_ = avr_->cycle + 1.0;
  avr_cycle_timer_register(
      avr_, avr_cycle_count_t(uart_line_free_) - avr_->cycle,
      [](avr_t*, avr_cycle_count_t when, void* self) -> avr_cycle_count_t {
        return static_cast<Mcu*>(self)->feed_uart(when);
      },
      this);
}

uint64_t Mcu::feed_uart(uint64_t) {
  const uint8_t byte = uart_in_.front();
  uart_in_.pop_front();
  const unsigned places = sizeof uart_->input.buffer / sizeof uart_->input.buffer[0];
  const unsigned unread = (uart_->input.write + places - uart_->input.read) % places;
  ++uart_received_;
  if (unread >= 3) {
    ++uart_overruns_;
  } else {
    avr_raise_irq(uart_input_, sampled(byte, uart_->cycles_per_byte / 10.0 / wire_bit()));
  }
  uart_line_free_ += 10 * wire_bit();
  uart_last_received_ = uart_line_free_ / avr_->frequency;
  uart_feeding_ = !uart_in_.empty();
  return uart_feeding_ ? uint64_t(uart_line_free_) : 0;
}

void Mcu::uart_output(uint8_t byte) {
  const uint64_t start = uart_out_free_ > avr_->cycle ? uart_out_free_ : avr_->cycle;
  uart_out_free_ = start + uart_->cycles_per_byte;
  uart_out_.emplace_back(uart_out_free_, sampled(byte, wire_bit() * 10.0 / uart_->cycles_per_byte));
}

std::vector<SentByte> Mcu::uart_take_sent() {
  std::vector<SentByte> sent;
  while (!uart_out_.empty() && uart_out_.front().first <= avr_->cycle) {
    sent.push_back({double(uart_out_.front().first) / avr_->frequency, uart_out_.front().second});
    uart_out_.pop_front();
  }
  return sent;
}

void Mcu::i2c_message(uint32_t value) {
  avr_twi_msg_irq_t message;
  message.u.v = value;
  const uint8_t kind = message.u.twi.msg;
  const uint8_t address = message.u.twi.addr;
  i2c_sending_ = false;
  if (kind & TWI_COND_STOP) i2c_selected_ = nullptr;
  if (kind & TWI_COND_START) {
    const auto found = i2c_devices_.find(address >> 1);
    i2c_selected_ = found == i2c_devices_.end() ? nullptr : found->second;
    if (i2c_selected_ != nullptr && !i2c_selected_->start(address & 1)) i2c_selected_ = nullptr;
    if (i2c_selected_ != nullptr) avr_raise_irq(i2c_input_, avr_twi_irq_msg(TWI_COND_ACK, address, 1));
  }
  if (i2c_selected_ == nullptr) return;
  if (kind & TWI_COND_WRITE) {
    i2c_selected_->write(message.u.twi.data);
    avr_raise_irq(i2c_input_, avr_twi_irq_msg(TWI_COND_ACK, address, 1));
  }
  if (kind & TWI_COND_READ) {
    avr_raise_irq(i2c_input_, avr_twi_irq_msg(TWI_COND_READ, address, i2c_selected_->read()));
    i2c_sending_ = kind & TWI_COND_ACK;
  }
}

void Mcu::adc_trigger(uint32_t value) {
  union {
    avr_adc_mux_t mux;
    uint32_t v;
  } trigger;
  memset(&trigger, 0, sizeof trigger);
  trigger.v = value;
  const int channel = trigger.mux.src;
  if (trigger.mux.kind != ADC_MUX_SINGLE || channel > 7 || !adc_volts) return;
  double reading = std::floor(adc_volts(channel) * 1024 / kVcc);
  reading = reading < 0 ? 0 : reading > 1023 ? 1023 : reading;
  avr_raise_irq(adc_ + channel, uint32_t(std::ceil(reading * kVcc * 1000 / 1023)));
}

std::vector<uint8_t> Mcu::eeprom() const {
  avr_eeprom_desc_t description = {nullptr, 0, avr_->e2end + 1u};
  std::vector<uint8_t> content(avr_->e2end + 1u);
  description.ee = content.data();
  avr_ioctl(avr_, AVR_IOCTL_EEPROM_GET, &description);
  return content;
}

void Mcu::set_eeprom(const std::vector<uint8_t>& content) {
  std::vector<uint8_t> copy(content);
  copy.resize(avr_->e2end + 1u, 0xFF);
  avr_eeprom_desc_t description = {copy.data(), 0, uint32_t(copy.size())};
  avr_ioctl(avr_, AVR_IOCTL_EEPROM_SET, &description);
}
