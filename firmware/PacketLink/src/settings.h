// Settings: numbers of a sketch that the bridge changes while it runs, such as the gains of a controller. One list has
// all of them; the variables, the rows that announce them and their table are made of it:

/*        number, variable, type, value at the start, minimum, maximum, unit, description
     #define SETTINGS(SETTING)                                       \
       SETTING(1, kp, float, 0.5, 0, 10, "1/s", "proportional gain") \
       SETTING(2, period, uint16_t, 20, 5, 1000, "ms", "between two packets")
*/
//   SETTINGS(SETTING_VARIABLE)                                     // float kp = 0.5; uint16_t period = 20;
//   const char kRows[] PROGMEM = "firmware: tuned 1.0\n" SETTINGS(SETTING_ROW);
//   constexpr Setting kSettings[] PROGMEM = {SETTINGS(SETTING_ENTRY)};
//
//   bridge.announce(kRows);                  // in setup(), for a PacketLink or a FrameLink
//   bridge.settings(kSettings);              // or (kSettings, changed), with void changed(uint8_t number)
//   bridge.update();                         // in loop(), often
//
// The type is bool (without limits: 0, 1), int8_t, uint8_t, int16_t, uint16_t, int32_t, uint32_t or float. Numbers are
// plain ones, without a suffix, and texts have no quotation marks, since the rows are YAML. A variable may also be the
// sketch's own, without SETTING_VARIABLE; another type than that of the list does not compile.
//
// What arrives is limited, written to the variable with interrupts disabled, and answered with the value in use. All
// settings are reported after the start, and then in turn, one each time a chunk of an announcement would be due.
// Nothing waits for room to send, and an answer leaves 40 bytes of it for the packets of the sketch; where the send
// buffer never has so much, it leaves with one of the reports. After a reset each has its value at the start; the bridge then sends those that
// somebody has set.

#ifndef SERIAL_COMMUNICATION_SETTINGS_H
#define SERIAL_COMMUNICATION_SETTINGS_H

#include <Arduino.h>
#include <string.h>
#if defined(__AVR__)
#include <util/atomic.h>
#endif

#include "stream_sink.h"

namespace serial_communication {

// A limit in the type in which it is compared, which begins with the bytes of the setting's own type.
union SettingLimit {
  constexpr SettingLimit(float number) : fraction(number) {}
  constexpr SettingLimit(int32_t number) : whole(number) {}
  constexpr SettingLimit(uint32_t number) : natural(number) {}
  float fraction;
  int32_t whole;
  uint32_t natural;
};

// An entry of the table.
struct Setting {
  uint8_t number;
  uint8_t size;    // bytes of the variable
  void* variable;
  bool (*set)(const Setting&, const uint8_t* value);
  SettingLimit minimum, maximum;
};

// Sets the variable to the value received, within its limits. Returns whether this changed it. Not a number changes
// nothing.
template <class T>
bool set_setting(const Setting& setting, const uint8_t* received) {
  T value, minimum, maximum;
  memcpy(&value, received, sizeof value);
  memcpy(&minimum, &setting.minimum, sizeof minimum);
  memcpy(&maximum, &setting.maximum, sizeof maximum);
  if (value != value) return false;
  if (value < minimum) value = minimum;
  if (value > maximum) value = maximum;
  if (memcmp(setting.variable, &value, sizeof value) == 0) return false;
#if defined(__AVR__)
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
#endif
  { memcpy(setting.variable, &value, sizeof value); }
  return true;
}

// The entry of a variable of type T. Raw: its type on the wire; Wide: that of its limits.
template <class T, class Raw, class Wide>
struct SettingAs {
  static constexpr Setting entry(uint8_t number, T* variable, Wide minimum, Wide maximum) {
    return {number, sizeof(T), variable, &set_setting<Raw>, minimum, maximum};
  }
};

template <class T> struct SettingOf;
template <> struct SettingOf<bool> : SettingAs<bool, uint8_t, uint32_t> {};
template <> struct SettingOf<int8_t> : SettingAs<int8_t, int8_t, int32_t> {};
template <> struct SettingOf<uint8_t> : SettingAs<uint8_t, uint8_t, uint32_t> {};
template <> struct SettingOf<int16_t> : SettingAs<int16_t, int16_t, int32_t> {};
template <> struct SettingOf<uint16_t> : SettingAs<uint16_t, uint16_t, uint32_t> {};
template <> struct SettingOf<int32_t> : SettingAs<int32_t, int32_t, int32_t> {};
template <> struct SettingOf<uint32_t> : SettingAs<uint32_t, uint32_t, uint32_t> {};
template <> struct SettingOf<float> : SettingAs<float, float, float> {};

#define SETTING_VARIABLE(number, variable, type, initial, minimum, maximum, unit, description) \
  type variable = initial;
#define SETTING_ROW(number, variable, type, initial, minimum, maximum, unit, description)      \
  #variable ": {setting: " #number ", layout: '<" SETTING_LAYOUT_##type(minimum, maximum)      \
  ", unit: '" unit "', description: '" description "'}\n"
#define SETTING_ENTRY(number, variable, type, initial, minimum, maximum, unit, description) \
  serial_communication::SettingOf<type>::entry(number, &variable, minimum, maximum),

// The layout and the limits in a row.
#define SETTING_LAYOUT_bool(minimum, maximum) "?'"
#define SETTING_LAYOUT_int8_t(minimum, maximum) "b', minimum: " #minimum ", maximum: " #maximum
#define SETTING_LAYOUT_uint8_t(minimum, maximum) "B', minimum: " #minimum ", maximum: " #maximum
#define SETTING_LAYOUT_int16_t(minimum, maximum) "h', minimum: " #minimum ", maximum: " #maximum
#define SETTING_LAYOUT_uint16_t(minimum, maximum) "H', minimum: " #minimum ", maximum: " #maximum
#define SETTING_LAYOUT_int32_t(minimum, maximum) "i', minimum: " #minimum ", maximum: " #maximum
#define SETTING_LAYOUT_uint32_t(minimum, maximum) "I', minimum: " #minimum ", maximum: " #maximum
#define SETTING_LAYOUT_float(minimum, maximum) "f', minimum: " #minimum ", maximum: " #maximum

// The settings of a link.
class SettingsTable {
 public:
  static const uint8_t kMost = 16;  // as many as an announcement has rows
  static const uint8_t kMaxData = 5;
  static const uint8_t kLeftFree = 40;  // bytes of the send buffer

  template <size_t Count>
  void begin(const Setting (&table)[Count], void (*changed)(uint8_t number)) {
    static_assert(Count <= kMost, "at most 16 settings");
    table_ = table;
    count_ = Count;
    changed_ = changed;
    turn_ = 0;
    at_ = Count - 1;
    due_ = static_cast<uint16_t>((1ul << Count) - 1);
  }

  // Takes what the bridge sent: the number of a setting, and its value. It is answered whatever the value is.
  void take(const uint8_t* data, size_t size) {
    for (uint8_t i = 0; i < count_; ++i) {
      const Setting setting = entry(i);
      if (size == 0 || setting.number != data[0]) continue;
      due_ |= static_cast<uint16_t>(1u << i);
      if (size == 1u + setting.size && setting.set(setting, data + 1) && changed_) changed_(setting.number);
      return;
    }
  }

  void report_one() {
    due_ |= static_cast<uint16_t>(1u << turn_);
    if (++turn_ >= count_) turn_ = 0;
  }

  // Writes the number and the value of a setting that has to be reported to `data`, which has room for kMaxData bytes.
  // Returns the size; 0: there is none, or the send buffer has less than `room`.
  uint8_t next(SendBuffer& buffer, uint8_t room, uint8_t* data) {
    if (due_ == 0 || !buffer.has_room(room)) return 0;
    do {
      if (++at_ >= count_) at_ = 0;
    } while ((due_ >> at_ & 1) == 0);
    due_ &= static_cast<uint16_t>(~(1u << at_));
    const Setting setting = entry(at_);
    data[0] = setting.number;
    memcpy(data + 1, setting.variable, setting.size);
    return 1 + setting.size;
  }

 private:
  Setting entry(uint8_t index) const {
    Setting setting = {0, 0, 0, 0, 0.0f, 0.0f};
    memcpy_P(&setting, table_ + index, sizeof setting);
    return setting;
  }

  // Without initial values, which would be code in every sketch: begin() comes before all else.
  const Setting* table_;  // in program memory
  void (*changed_)(uint8_t number);
  uint16_t due_;  // a bit for each setting that has to be reported
  uint8_t count_;
  uint8_t turn_;  // the one that is reported next without having been asked for
  uint8_t at_;    // the one that was reported last
};

}  // namespace serial_communication

// Only this name needs no serial_communication:: in a sketch.
using serial_communication::Setting;

#endif
