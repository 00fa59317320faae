// Packed structs as they cross the wire: custom messages, which need no further code.
//
//   struct PACKED Force { int16_t centinewtons; };
//
// The fields of the struct have the order of the configuration's `layout`, which begins with '<':
// every board this runs on is little-endian.

#ifndef SERIAL_COMMUNICATION_PACKED_H
#define SERIAL_COMMUNICATION_PACKED_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#ifndef PACKED
#define PACKED __attribute__((packed))
#endif

namespace serial_communication {

static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "packed structs are sent as they stand");

template <class T>
struct IsPointer {
  static const bool value = false;
};
template <class T>
struct IsPointer<T*> {
  static const bool value = true;
};

// Does not compile for a T that cannot be sent as its bytes.
template <class T>
inline void check_can_cross_the_wire() {
  static_assert(!IsPointer<T>::value, "this is a pointer: give what it points at");
  static_assert(__is_trivially_copyable(T), "only plain numbers and structs of them can be sent, no String");
  static_assert(!__is_class(T) || alignof(T) == 1, "a struct that is sent has to be PACKED");
}

// The least number of bytes that a T is received with: all of it, or T::LEAST. The header that `header` makes has
// LEAST in a struct whose last value has any length. What was not received is 0.
template <class T, class = uint16_t>
struct LeastSize {
  static const uint16_t value = sizeof(T);
};
template <class T>
struct LeastSize<T, decltype(static_cast<uint16_t>(T::LEAST))> {
  static const uint16_t value = T::LEAST;
};

// A T from what was received of it, at most all of its bytes.
template <class T>
inline T from_received(const uint8_t* data, size_t size) {
  T value = T();
  memcpy(static_cast<void*>(&value), data, size);
  return value;
}

// False, and `*value` untouched, where the data has another size.
template <class T>
inline bool from_bytes(const uint8_t* data, size_t size, T* value) {
  check_can_cross_the_wire<T>();
  if (size != sizeof *value) return false;
  memcpy(value, data, sizeof *value);
  return true;
}

}  // namespace serial_communication

#endif
