"""Rows of custom messages -> the text of a C++11 header.

The header is for any compiler with GCC's attributes, on a little-endian processor. It includes
nothing but <stdint.h> and <string.h>, so it also works without the library of this package.
"""
import math
import re
import struct
from typing import Any, Dict, Iterable, List, Set, Tuple

from ...framing.announcement import write_announcement
from ...framing.layout import BOARD_TIME, FRACTIONS, Layout, Value
from ...framing.settings import Setting

_TYPES = {'b': 'int8_t', 'B': 'uint8_t', 'h': 'int16_t', 'H': 'uint16_t', 'i': 'int32_t',
          'I': 'uint32_t', 'l': 'int32_t', 'L': 'uint32_t', 'q': 'int64_t', 'Q': 'uint64_t',
          'e': 'uint16_t', 'f': 'float', 'd': 'double', '?': 'uint8_t'}
_KEYWORDS = set('''
    alignas alignof and and_eq asm auto bitand bitor bool break case catch char char16_t char32_t
    class compl const const_cast constexpr continue decltype default delete do double dynamic_cast
    else enum explicit export extern false float for friend goto if inline int long mutable
    namespace new noexcept not not_eq nullptr operator or or_eq private protected public register
    reinterpret_cast return short signed sizeof static static_assert static_cast struct switch
    template this thread_local throw true try typedef typeid typename union unsigned using virtual
    void volatile wchar_t while xor xor_eq
    char8_t co_await co_return co_yield concept consteval constinit requires
    boolean byte word linux unix'''.split())   # the last line: Arduino's, and macros of GNU C++
# Names that this header uses itself; a row or a field of that name gets another one.
_OWN = {'BigEndian', 'Count', *_TYPES.values()}
# So does a row with the name of a class or an object of the Arduino core, of a usual library, or of
# this package's library.
_CLASSES = {'String', 'Serial', 'Print', 'Stream', 'Printable', 'Server', 'Client', 'Servo', 'Wire',
            'Announcer', 'BusResult', 'BusSlave', 'FrameLink', 'ImuData', 'MessageType', 'Packet',
            'HeartbeatWatch', 'PacketLink', 'RateLimit', 'SensorStatus', 'Setting', 'StreamSink'}
# A setting is a variable: it may not have the name of a function of the Arduino core, or of C.
_FUNCTIONS = set('''
    abort abs access acos alarm asin atan atan2 atof atoi bsearch calloc ceil clock close
    copysign cos cosh delay div dup exit exp fabs ffs floor fma fmax fmin fmod fork free frexp
    gamma getc gets hypot index init interrupts isatty j0 j1 jn labs ldexp ldiv link log log10
    loop lrint lround ltoa malloc map micros millis modf nice open pause perror pipe pow printf
    putc putchar puts qsort raise rand random read realloc remove rename rewind rindex rint
    rmdir round scanf setup signal sin sinh sleep sqrt square srand stat swab sync system tan
    tanh time tone trunc ungetc unlink wait write y0 y1 yn yield'''.split())
_WORDS = {'e': 'the bits of a float of 16 bits', '?': '0: false, 1: true'}
_LARGEST_FLOAT = 3.4e38

_TOP = """\
// Custom messages of the board "{link}", made by `header` from {file}.
// Do not change this file: change the rows in {file}, and make it again.
//
// A value is raw * scale + offset; a struct has the raw numbers.

#pragma once

#include <stdint.h>
#include <string.h>

#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "the structs below are for a little-endian processor"
#endif
"""

_BIG_ENDIAN = """
// A number whose bytes are in big-endian order; used like a T.
template <class T>
struct __attribute__((packed)) BigEndian {
  uint8_t bytes[sizeof(T)];
  BigEndian(T value = T()) {
    memcpy(bytes, &value, sizeof(T));
    reverse(bytes);
  }
  operator T() const {
    BigEndian other = *this;
    reverse(other.bytes);
    T value;
    memcpy(&value, other.bytes, sizeof(T));
    return value;
  }

 private:
  static void reverse(uint8_t* bytes) {
    for (uint8_t i = 0; i < sizeof(T) / 2; ++i) {
      const uint8_t byte = bytes[i];
      bytes[i] = bytes[sizeof(T) - 1 - i];
      bytes[sizeof(T) - 1 - i] = byte;
    }
  }
};
"""


_SETTINGS = """\
// Settings: numbers that the bridge changes while the sketch runs. With this package's library:
//
//   SETTINGS(SETTING_VARIABLE)                                          // the variables
//   constexpr Setting kSettings[] PROGMEM = {{SETTINGS(SETTING_ENTRY)}};  // for bridge.settings()
//
// Number, variable, type, value at the start, minimum, maximum, unit, description.
#define SETTINGS(SETTING) \\
{}
"""


def header(file: str, link: str, read: Iterable[Any], values: Dict[str, Any],
           rows: Dict[str, Any]) -> str:
    """The text of the header.

    Args:
        file: the name of the configuration.
        link: the name of the board's link.
        read: the rows, as the board's description reads them.
        values: those of the settings at the start, by name.
        rows: the same rows, as the file has them.
    """
    names = _Names(_OWN | _CLASSES)
    parts = [part for row in read if not isinstance(row, Setting) for part in _row(row, names)]
    variables = _Names(names.taken | _FUNCTIONS)
    settings = [_setting(row, values[row.name], variables) for row in read
                if isinstance(row, Setting)]
    if settings:
        parts.append(_SETTINGS.format(' \\\n'.join(settings)))
    big_endian = any('BigEndian<' in part for part in parts)
    return '\n'.join([_TOP.format(file=_one_line(file), link=link) + _BIG_ENDIAN * big_endian,
                      *parts, _announcement(rows)])


class _Names:
    """Makes names that are valid in C++, each once."""

    def __init__(self, taken: Iterable[str] = ()) -> None:
        self.taken: Set[str] = set(taken)

    def new(self, name: str, other: str) -> str:
        """This name; if it is taken, the other one, or that with a number."""
        # Names without a small letter are often macros of the Arduino core, such as A0 or PI.
        if name in self.taken | _KEYWORDS or not re.search('[a-z]', name):
            name, number = other, 2
            while name in self.taken:
                name, number = f'{other}_{number}', number + 1
        self.taken.add(name)
        return name


def _row(row: Any, names: _Names) -> List[str]:
    """The structs of one row, and the constant with its number."""
    key, number = row.number
    where = f'// {row.name}, {row.purpose}'
    structs = [(suffix, layout) for suffix, layout in row.layouts.items() if not layout.is_empty]
    camel = ''.join(word[:1].upper() + word[1:] for word in row.name.split('_'))
    made = [_struct(where, names.new(camel + suffix, f'{camel}{suffix}Message'), key.upper(),
                    number, layout) for suffix, layout in structs]
    if made:
        return made
    name = names.new(camel, f'{camel}Message')
    return [f'{where}: no data\nstruct {name} {{\n'
            f'  enum : uint8_t {{ {key.upper()} = {number} }};\n}};\n']


def _setting(row: Setting, value: Any, names: _Names) -> str:
    """Its line in the list."""
    variable = names.new(row.name, f'{row.name}_setting')
    type_ = 'bool' if row.code == '?' else _TYPES[row.code]
    numbers = [f'{number!r}' if row.code in FRACTIONS else f'{int(number)}'
               for number in (value, row.minimum, row.maximum)]
    texts = [f'"{_escaped(text.encode())}"' for text in (row.unit, row.description)]
    return f'  SETTING({", ".join([str(row.setting), variable, type_, *numbers, *texts])})'


def _struct(where: str, name: str, key: str, number: int, layout: Layout) -> str:
    """One packed struct, with a template argument if its last value has any length."""
    fields, constants = _members(layout, name)
    size, instance = layout.size, name
    lines = [where]
    last = layout.values[-1] if layout.values else None
    enums = [f'  enum : uint8_t {{ {key} = {number} }};']
    if last and last.end < 0:
        enums.append(f'  enum : uint16_t {{ LEAST = {size} }};  // bytes before the last value')
        lines = [f'{where}; Count: the most that {_member(last.name)} may have',
                 'template <uint16_t Count>']
        size += 1 if last.code == 's' else Layout(layout.layout[0] + last.code, [last]).size
        instance = f'{name}<1>'
    why = f'{name} has {size} bytes'
    if any(value.code == 'd' for value in layout.values):
        why += ', and a double has 8: on an AVR use f in the layout'
    return '\n'.join([
        *lines, f'struct __attribute__((packed)) {name} {{',
        *enums, *fields, *constants, '};',
        f'static_assert(sizeof({instance}) == {size}, "{why}");', ''])


def _members(layout: Layout, struct: str) -> Tuple[List[str], List[str]]:
    """The lines of the struct's fields, and those of their constants."""
    names = _Names(_OWN | {struct})
    fields: List[str] = []
    named: List[Tuple[Value, str]] = []
    at = 0
    for value in layout.values:
        if value.start > at:
            fields.append(f'  uint8_t {names.new("padding", "padding")}[{value.start - at}];')
        name = names.new(_member(value.name), _member(value.name) + '_')
        fields.append(f'  {_declared(value, name, layout.layout[0])};{_comment(value)}')
        named.append((value, name))
        at = value.end if value.end >= 0 else layout.size
    if layout.size > at:
        fields.append(f'  uint8_t {names.new("padding", "padding")}[{layout.size - at}];')
    # After all fields, so that a field keeps its name: with a field x_scale, the scale of x is
    # x_scale_.
    return fields, [line for value, name in named for line in _constants(value, name, names)]


def _member(path: str) -> str:
    """The name of a field: vector.x -> vector_x, position[2] -> position_2, @time -> time."""
    return re.sub(r'\W+', '_', path.strip('@').replace(']', '')) or 'left_out'


def _declared(value: Value, name: str, order: str) -> str:
    if value.code == 's':
        return f'char {name}[{value.room or "Count"}]'
    type_ = _TYPES[value.code]
    if order == '>' and type_ not in ('int8_t', 'uint8_t'):
        type_ = f'BigEndian<{type_}>'
    return f'{type_} {name}' + '[Count]' * (value.end < 0)


def _comment(value: Value) -> str:
    words = []
    if value.name == BOARD_TIME:
        words.append("microseconds of the board's clock, when it is measured")
    elif value.code == 's':
        words.append('text; it ends at its first 0x00')
    elif value.code in _WORDS:
        words.append(_WORDS[value.code])
    if value.is_scaled:
        words.append(f'raw * {value.scale:.10g}' + (
            f' {"+-"[value.offset < 0]} {abs(value.offset):.10g}' if value.offset else ''))
    if not value.name:
        words.append('the bridge leaves it out')
    if value.invalid is not None:
        words.append(f'{value.invalid:.10g} raw: no value')
    low, high = value.minimum, value.maximum
    if low > -math.inf or high < math.inf:
        words.append(f'at least {low:.10g}' if high == math.inf else f'at most {high:.10g}'
                     if low == -math.inf else f'{low:.10g} to {high:.10g}')
    return '  // ' + ', '.join(words) if words else ''


def _constants(value: Value, field: str, names: _Names) -> List[str]:
    """Functions with a value's scale, offset, limits and "no value"; not constants, which need a
    definition. And the one that fills the board's time."""
    if value.name == BOARD_TIME:
        name = names.new('measured_at', 'measured_at_')
        return [f'  void {name}(uint32_t microseconds) {{ {field} = microseconds; }}']
    given = (('scale', value.scale, 1), ('offset', value.offset, 0),
             ('minimum', value.minimum, -math.inf), ('maximum', value.maximum, math.inf))
    functions = [('float', what, f'{float(number)!r}f') for what, number, default in given
                 if value.name and number != default and abs(number) < _LARGEST_FLOAT]
    if value.invalid is not None:
        functions.append((_TYPES[value.code], 'invalid', _raw(value.invalid, value.code)))
    return [f'  static constexpr {type_} {names.new(f"{field}_{what}", f"{field}_{what}_")}() '
            f'{{ return {number}; }}' for type_, what, number in functions]


def _raw(number: float, code: str) -> str:
    """A raw number in C++."""
    if code == 'e':
        number, = struct.unpack('<H', struct.pack('<e', number))
    elif code in FRACTIONS:
        sign = '-' * (number < 0)
        return f'{sign}__builtin_inf()' if math.isinf(number) else \
            f'{float(number)!r}' + 'f' * (code == 'f')
    # The literal 9223372036854775808 is too great for a signed type.
    return '-9223372036854775807 - 1' if number == -2 ** 63 else \
        f'{int(number)}' + 'u' * (number >= 2 ** 63)


def _announcement(rows: Dict[str, Any]) -> str:
    """The text with which the board announces these rows."""
    try:
        text = write_announcement(rows)
    except ValueError as error:
        return f'// No announcement: {error}\n'
    quoted = '\n'.join(f'    "{_escaped(line)}"' for line in text.splitlines(keepends=True))
    return f"""\
// These rows, for `announce(kAnnouncement)` of a link. If FIRMWARE_NAME and FIRMWARE_VERSION, two
// texts, are defined before this file is included, the board announces them, too.
#ifdef __AVR__
#include <avr/pgmspace.h>
#define SERIAL_COMMUNICATION_FLASH PROGMEM
#else
#define SERIAL_COMMUNICATION_FLASH
#endif
const char kAnnouncement[] SERIAL_COMMUNICATION_FLASH =
#ifdef FIRMWARE_NAME
    "firmware: " FIRMWARE_NAME " " FIRMWARE_VERSION "\\n"
#endif
{quoted};
"""


def _escaped(line: bytes) -> str:
    """A line as the contents of a C string, in UTF-8."""
    return ''.join(chr(byte) if 32 <= byte < 127 and byte not in b'"\\?' else f'\\{byte:03o}'
                   for byte in line).replace('\\012', '\\n')


def _one_line(text: str) -> str:
    """Text that is safe in a // comment."""
    return re.sub(r'[^ -~]|\\', '?', text)
