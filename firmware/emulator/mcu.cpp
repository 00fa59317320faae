// See mcu.h. What libsimavr 1.6 does differently from the chip, and what is done about it:
//
// - Its UART counts a parity bit that 8N1 does not have: the time of a byte is put right after each
//   write to UBRR0.
// - Its UART hands out a byte when the program writes it; it leaves here when its stop bit would end.
// - It takes input as fast as it is given, into 64 places: bytes are fed at wire speed, and one that
//   would find two bytes and the shift register full is lost and counted, as on the chip.
// - By default it sleeps a microsecond on each read of UCSR0A and prints what is sent: switched off.
// - Its ADC computes volts * 1023 / reference, the chip 1024: the voltage given to it makes up for that.
// - Its sleep would call usleep() and lose time at every call: the pace is kept outside, in main().
// - It polls a low pin of a level-triggered INT each cycle, enabled or not, and INT1 (pin 3) is one
//   after a reset: switched off, or the chip would never sleep.
// - After a reset all its cycle timers are gone: they are started again. So are the levels of input
//   pins, and a pin ignores a level that it has had: each driven pin is given the other level first.
// - Each write to a port pulls its input pins up again, over what drives them from outside: it is told
//   of every level that is driven.
// - TWI: START and the address take no time, data bytes take their nine clocks.

#include "mcu.h"

#include <cmath>
#include <cstring>
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
#include <sim_io.h>
}

namespace {

const uint32_t kFrequency = 16000000;
const uint16_t kUbrr0l = 0xC4;
const double kVcc = 5.0;
// How many cycles the core may run between two looks at its timers.
const avr_cycle_count_t kRunCycleLimit = 64;

void keep_pace_elsewhere(avr_t*, avr_cycle_count_t) {}

void log_errors(avr_t*, const int level, const char* format, va_list arguments) {
  if (level == LOG_ERROR) vfprintf(stderr, format, arguments);
}

}  // namespace

Mcu::Mcu(const std::string& elf, unsigned baud) : cycles_per_wire_byte_(10.0 * kFrequency / baud) {
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
  avr_->sleep = keep_pace_elsewhere;

  uart_ = nullptr;
  for (avr_io_t* io = avr_->io_port; io != nullptr; io = io->next) {
    if (strcmp(io->kind, "uart") == 0) uart_ = reinterpret_cast<avr_uart_t*>(io);
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

  adc_ = avr_io_getirq(avr_, AVR_IOCTL_ADC_GETIRQ, ADC_IRQ_ADC0);
  avr_irq_register_notify(
      avr_io_getirq(avr_, AVR_IOCTL_ADC_GETIRQ, ADC_IRQ_OUT_TRIGGER),
      [](avr_irq_t*, uint32_t value, void* self) { static_cast<Mcu*>(self)->adc_trigger(value); }, this);
  start_timers();
}

Mcu::~Mcu() { avr_terminate(avr_); }

uint64_t Mcu::cycles() const { return avr_->cycle; }
uint64_t Mcu::frequency() const { return avr_->frequency; }
uint32_t Mcu::program_counter() const { return avr_->pc; }
uint8_t Mcu::data(uint16_t address) const { return avr_->data[address]; }

bool Mcu::run_until(uint64_t cycle) {
  while (avr_->cycle < cycle) {
    const int state = avr_run(avr_);
    if (state == cpu_Crashed || state == cpu_Done) return false;
  }
  return true;
}

void Mcu::reset() {
  avr_reset(avr_);
  avr_->state = cpu_Running;
  uart_in_.clear();
  uart_feeding_ = false;
  i2c_selected_ = nullptr;
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
  reset();
  uint32_t noise = 1;
  for (uint32_t address = avr_->ioend + 1u; address <= avr_->ramend; ++address) {
    noise = noise * 1664525 + 1013904223;
    avr_->data[address] = uint8_t(noise >> 24);
  }
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

void Mcu::drive_pin(char port, int bit, bool level) {
  DrivenPins& pins = driven_pins_[port];
  pins.mask |= uint8_t(1 << bit);
  pins.levels = uint8_t((pins.levels & ~(1 << bit)) | level << bit);
  apply_driven_pins(port, pins);
  avr_raise_irq(avr_io_getirq(avr_, uint32_t(AVR_IOCTL_IOPORT_GETIRQ(port)), bit), level);
}

void Mcu::apply_driven_pins(char port, const DrivenPins& pins) {
  avr_ioport_external_t external;
  memset(&external, 0, sizeof external);
  external.name = (unsigned long)port & 0x7F;
  external.mask = pins.mask;
  external.value = pins.levels;
  avr_ioctl(avr_, uint32_t(AVR_IOCTL_IOPORT_SET_EXTERNAL(port)), &external);
}

// UART: from the wire into the chip. simavr makes a byte readable one byte time after it was given,
// so what is given here is the start bit.
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
    avr_raise_irq(uart_input_, byte);
  }
  uart_line_free_ += cycles_per_wire_byte_;
  uart_last_received_ = uart_line_free_ / avr_->frequency;
  uart_feeding_ = !uart_in_.empty();
  return uart_feeding_ ? uint64_t(uart_line_free_) : 0;
}

void Mcu::uart_output(uint8_t byte) {
  const uint64_t start = uart_out_free_ > avr_->cycle ? uart_out_free_ : avr_->cycle;
  uart_out_free_ = start + uart_->cycles_per_byte;
  uart_out_.emplace_back(uart_out_free_, byte);
}

std::string Mcu::uart_take_sent() {
  std::string sent;
  while (!uart_out_.empty() && uart_out_.front().first <= avr_->cycle) {
    sent.push_back(char(uart_out_.front().second));
    uart_out_.pop_front();
  }
  return sent;
}

void Mcu::i2c_message(uint32_t value) {
  avr_twi_msg_irq_t message;
  message.u.v = value;
  const uint8_t kind = message.u.twi.msg;
  const uint8_t address = message.u.twi.addr;
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
