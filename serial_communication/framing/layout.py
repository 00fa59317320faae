"""Messages that are rows: a struct format and, for each value in it, its name and its limits.

A `Layout` unpacks and packs such a message, says what is implausible, prints it, and tells which
bytes are which value. `message_class` makes the class of a message from one: the simple messages
of the three links are made so, and so are those that users add by parameters.
"""
import re
import struct
from collections import namedtuple
from math import inf, isfinite
from typing import Any, List, NamedTuple, Optional, Sequence, Tuple
from unicodedata import category

from .parts import Part

NUMBERS = 'bBhHiIlLqQefd?'     # struct's codes that hold one number each
FRACTIONS = 'efd'             # of these, the ones that need not be whole
_RANGES = {'?': (0, 1), 'e': (-65504.0, 65504.0), 'f': (-3.4028234663852886e38,
           3.4028234663852886e38), 'd': (-inf, inf), 's': (-inf, inf)}


class Value(NamedTuple):
    """One value of a message: value = raw * scale + offset."""

    name: str                  # '': left out, packed as 0
    unit: str = ''
    scale: float = 1
    offset: float = 0
    minimum: float = -inf      # of the value, not of the raw number
    maximum: float = inf
    place: str = ''            # struct's code of where the value goes on: what it cannot hold
    #                            is implausible; '': anywhere


class LayoutTooLong(ValueError):
    """A format with more data than a message can carry."""


class _Item(NamedTuple):
    """One value's place in the data."""

    code: str      # struct's code, 's' for a text
    start: int
    end: int       # -1: it goes on to the data's end


class Layout:
    """A struct format with its values.

    Args:
        layout: a format of the struct module that begins with ``<`` or ``>``. A last ``*``
            repeats the character before it to the data's end: one value, a tuple. A last ``s``
            without a number is text to the data's end or its first 0x00. Texts are UTF-8.
        values: one for each value in the format.

    Raises:
        ValueError: a format that cannot be, or another number of values than it has.
    """

    def __init__(self, layout: str, values: Sequence[Value]) -> None:
        self.layout = layout
        self.values = tuple(values)
        self._order = layout[:1]
        fixed, self._rest = _split(layout)
        self._items = _items(fixed, self._rest)
        self._struct = struct.Struct(fixed)
        self._step = struct.calcsize(self._order + (self._rest or 'x'))
        self.size = self._struct.size      # bytes of data; the least where more are allowed
        self.is_empty = not self.size and not self._items
        if len(self._items) != len(self.values):
            raise ValueError(f'it has {len(self._items)} values, not {len(self.values)}')
        self._has_text = any(item.code == 's' for item in self._items)
        self._is_plain = all(value.scale == 1 and value.offset == 0 for value in values)
        self._is_numbers = not self._rest and not self._has_text    # … one for each value
        # A whole number stays one where there is nothing to scale, also with a scale of 1.0.
        self._factors = [(1, 0) if value.scale == 1 and value.offset == 0
                         else (value.scale, value.offset) for value in values]
        # Of each value with limits: where it is, whether they are all that there is to check.
        self._checked = [(index, not value.place and self.kind(index) == 'number', value.minimum,
                          value.maximum) for index, value in enumerate(self.values)
                         if value.place or value.minimum > -inf or value.maximum < inf]

    # -- bytes and values -----------------------------------------------------------------

    def fits(self, size: int) -> bool:
        """Whether data of so many bytes can be such a message."""
        if self._rest:
            return size >= self.size and (size - self.size) % self._step == 0
        return size == self.size

    def sizes(self) -> str:
        """How many bytes of data it has, in words."""
        if not self._rest:
            return f'{self.size}'
        return f'{self.size} or {self._step} more, {2 * self._step} more …'

    def unpack(self, data: bytes) -> Tuple:
        """The values; struct.error where `data` has not the right length."""
        if self._is_numbers:
            raw = self._struct.unpack(data)
            if self._is_plain:
                return raw
            return tuple([number * scale + offset
                          for number, (scale, offset) in zip(raw, self._factors)])
        return tuple([_value(raw, value) for raw, value in zip(self.raw(data), self.values)])

    def raw(self, data: bytes) -> Tuple:
        """The numbers and texts as they were sent; struct.error as in `unpack`."""
        if not self.fits(len(data)):
            raise struct.error(f'{len(data)} bytes of data, not {self.sizes()}')
        raw = self._struct.unpack_from(data)
        if self._rest == 's':
            raw += (data[self.size:],)
        elif self._rest:
            count = (len(data) - self.size) // self._step
            raw += (struct.unpack_from(f'{self._order}{count}{self._rest}', data, self.size),)
        if not self._has_text:
            return raw
        return tuple([each.split(b'\0', 1)[0].decode('utf-8', 'replace')
                      if isinstance(each, bytes) else each for each in raw])

    def pack(self, values: Sequence) -> bytes:
        """The data of these values.

        Raises:
            ValueError: a value that its place cannot hold, or another number of them.
        """
        if len(values) != len(self.values):
            raise ValueError(f'{len(values)} values, not {len(self.values)}')
        data = bytearray(self.size)
        for given, value, item in zip(values, self.values, self._items):
            if not value.name:
                continue
            try:
                packed = self._packed(given, value, item)
            except (struct.error, OverflowError, TypeError, ValueError, AttributeError):
                raise ValueError(f'{value.name} is {brief(given, 40)}, which its place '
                                 f'({item.code}) cannot hold') from None
            data[item.start:item.start + len(packed)] = packed
        return bytes(data)

    def pack_raw(self, raw: Sequence) -> bytes:
        """The data of raw numbers, where nothing goes on to its end; struct.error as in struct."""
        return self._struct.pack(*raw)

    def _packed(self, given: Any, value: Value, item: _Item) -> bytes:
        if item.code == 's':
            text = given.encode()
            if b'\0' in text or 0 <= item.end < item.start + len(text):
                raise ValueError
            return text
        numbers = (given,) if item.end > 0 else given
        return struct.pack(f'{self._order}{len(numbers)}{item.code}',
                           *[_raw(number, value, item.code) for number in numbers])

    def range(self, index: int) -> Tuple[float, float]:
        """The least and the largest value that a place holds; without limits for a text."""
        code, value = self._items[index].code, self.values[index]
        low, high = _RANGES.get(code) or _whole_range(code)
        ends = sorted((low * value.scale + value.offset, high * value.scale + value.offset))
        return ends[0], ends[1]

    def kind(self, index: int) -> str:
        """What a value is: 'number', 'array' (of numbers) or 'text'."""
        item = self._items[index]
        return 'text' if item.code == 's' else 'number' if item.end >= 0 else 'array'

    def room(self, index: int) -> Optional[int]:
        """Bytes of a value; None: as many as there are."""
        item = self._items[index]
        return item.end - item.start if item.end >= 0 else None

    def is_whole(self, index: int) -> bool:
        """Whether a value is a whole number, or several, whatever is sent."""
        value = self.values[index]
        return self._items[index].code not in FRACTIONS + 's' and (
            (value.scale, value.offset) == (1, 0)
            or isinstance(value.scale, int) and isinstance(value.offset, int))

    def may_be_nan(self, index: int) -> bool:
        """Whether a value may be no number, or infinite."""
        return self._items[index].code in FRACTIONS

    # -- what values say --------------------------------------------------------------------

    def implausible(self, values: Sequence) -> str:
        """Why one of these values cannot be; '' where all can."""
        for index, is_simple, minimum, maximum in self._checked:
            if not is_simple or not minimum <= values[index] <= maximum:
                reason = _objection(values[index], self.values[index])
                if reason:
                    return reason
        return ''

    def text(self, values: Sequence) -> str:
        """The values by name, in one line; a value named ``value`` stands alone."""
        return ' '.join(('' if value.name == 'value' else value.name + '=')
                        + _words(given, value.unit)
                        for given, value in zip(values, self.values) if value.name)

    def parts(self, data: bytes) -> List[Part]:
        """Which bytes of `data` are which value, whatever its length is."""
        parts: List[Part] = []
        whole = len(data) if self.fits(len(data)) else self.size
        values = self.raw((data + bytes(self.size))[:whole])
        for raw, value, item in zip(values, self.values, self._items):
            self._pad(parts, data, item.start)
            start = min(item.start, len(data))
            end = min(item.end if item.end >= 0 else whole, len(data))
            name, missing = value.name or 'left out', item.end - len(data)
            if missing > 0:
                missing = min(missing, item.end - item.start)
                parts.append(Part(start, end, name, data[start:end],
                                  unit=value.unit).cut_short(missing))
            else:
                given = _value(raw, value)
                parts.append(Part(start, end, name, data[start:end], raw, given, value.unit,
                                  error=_objection(given, value)))
        self._pad(parts, data, min(self.size, len(data)))
        at = parts[-1].end if parts else 0
        if at < len(data):
            parts.append(Part(at, len(data), 'surplus', data[at:],
                              error=f'{len(data)} bytes of data, not {self.sizes()}'))
        return parts

    @staticmethod
    def _pad(parts: List[Part], data: bytes, start: int) -> None:
        """Bytes that hold no value stand before `start`."""
        at, start = parts[-1].end if parts else 0, min(start, len(data))
        if start > at:
            parts.append(Part(at, start, 'padding', data[at:start]))


def _split(layout: str) -> Tuple[str, str]:
    """The format without what goes on to the data's end, and that one's code, or ''."""
    if layout[:1] not in ('<', '>'):
        raise ValueError('it does not begin with < or >')
    fixed, rest = layout.replace(' ', ''), ''
    if fixed.endswith('*'):
        fixed, rest = fixed[:-2], fixed[-2:-1]
        if rest not in tuple(NUMBERS):
            raise ValueError(f'a * repeats one of {NUMBERS}')
    elif fixed.endswith('s') and not fixed[-2:-1].isdigit():
        fixed, rest = fixed[:-1], 's'
    if fixed[-1:].isdigit():
        raise ValueError('what goes on to the end of the data has no number before it')
    return fixed, rest


def _size(fixed: str) -> int:
    try:
        return struct.calcsize(fixed)
    except struct.error as error:
        raise ValueError(f'struct refuses it: {error}') from None


def _items(fixed: str, rest: str) -> List[_Item]:
    """Where each value stands."""
    size = _size(fixed)
    items, at = [], 0
    for number, code in re.findall(r'(\d*)(.)', fixed[1:]):
        count, each = int(number or 1), struct.calcsize(fixed[0] + code)
        if code == 's':
            items.append(_Item(code, at, at + count))
        elif code in NUMBERS:
            items += [_Item(code, at + index * each, at + (index + 1) * each)
                      for index in range(count)]
        elif code != 'x':
            raise ValueError(f'{code} holds no number and no text')
        at += count * each
    return items + [_Item(rest, size, -1)] * bool(rest)


def count_values(layout: str, longest: int) -> int:
    """How many values a format has.

    Raises:
        LayoutTooLong: it has more than `longest` bytes of data; found before memory is taken for
            them, since a few characters can ask for any number of values.
        ValueError: a format that cannot be.
    """
    fixed, rest = _split(layout)
    if _size(fixed) > longest:
        raise LayoutTooLong(f'it has more than {longest} bytes')
    return len(_items(fixed, rest))


def _whole_range(code: str) -> Tuple[int, int]:
    """The least and the largest number of a code for whole ones."""
    bits = 8 * struct.calcsize('<' + code)
    return (0, 2 ** bits - 1) if code.isupper() else (-2 ** (bits - 1), 2 ** (bits - 1) - 1)


def _value(raw: Any, value: Value) -> Any:
    """The value of a number, of each number of a tuple, or the text itself."""
    if isinstance(raw, str) or (value.scale == 1 and value.offset == 0):
        return raw
    if isinstance(raw, tuple):
        return tuple([each * value.scale + value.offset for each in raw])
    return raw * value.scale + value.offset


def _raw(number: Any, value: Value, code: str) -> Any:
    """The nearest raw number; OverflowError, TypeError or ValueError where there is none."""
    if not isinstance(number, (int, float)):
        raise TypeError
    if value.scale != 1 or value.offset != 0:
        number = (number - value.offset) / value.scale
    if code == '?':
        if not isfinite(number):
            raise ValueError
        return number != 0
    return number if code in FRACTIONS else round(number)


def _objection(given: Any, value: Value) -> str:
    """Why a value cannot be, or ''."""
    if isinstance(given, str):
        return ''
    for number in given if isinstance(given, tuple) else (given,):
        if (value.minimum > -inf or value.maximum < inf) and not (
                value.minimum <= number <= value.maximum):
            return f'{value.name} is {number:.6g}, {_limits(value)}'
        if value.place and not holds(value.place, number):
            return f'{value.name} is {number:.6g}, which its place in the message cannot hold'
    return ''


def _limits(value: Value) -> str:
    if value.maximum == inf:
        return f'under {value.minimum:g} {value.unit}'.rstrip()
    if value.minimum == -inf:
        return f'over {value.maximum:g} {value.unit}'.rstrip()
    return f'not within {value.minimum:g} to {value.maximum:g} {value.unit}'.rstrip()


def holds(code: str, number: float) -> bool:
    """Whether a place of struct's `code` can hold a number, rounded where it holds integers."""
    try:
        struct.pack('<' + code, number if code in FRACTIONS else round(number))
    except (struct.error, OverflowError, ValueError):
        return False
    return True


def _words(given: Any, unit: str) -> str:
    if isinstance(given, str):
        return repr(readable(given))
    if isinstance(given, tuple):
        words = '[' + ' '.join(_words(number, '') for number in given) + ']'
    elif isinstance(given, bool):
        words = str(given).lower()
    else:
        words = f'{given:.6g}' if isinstance(given, float) else str(given)
    return f'{words} {unit}'.rstrip()


def brief(given: Any, most: int) -> str:
    """What a value is, in at most so many characters."""
    try:
        words = repr(given)
    except ValueError:      # Python prints no integer of over 4300 digits
        words = f'{type(given).__name__} with too many digits'
    return words if len(words) <= most else words[:most - 1] + '…'


class Row:
    """Base of a message that is a row: see `message_class`. A tuple of its values."""

    __slots__ = ()
    TYPE: int
    LABEL: str
    LAYOUT: Layout

    @classmethod
    def unpack(cls, data: bytes) -> Any:
        """From the data; struct.error where it has not the right length."""
        return cls._make(cls.LAYOUT.unpack(data))

    def pack(self) -> bytes:
        """The data; ValueError where a value does not fit its place."""
        return self.LAYOUT.pack(self)

    def implausible(self) -> str:
        """Why these values cannot be, or ''."""
        return self.LAYOUT.implausible(self)

    @classmethod
    def parts(cls, data: bytes) -> List[Part]:
        """Which bytes of the data are which value, whatever its length is."""
        return cls.LAYOUT.parts(data)

    def __str__(self) -> str:
        return f'{self.LABEL} {self.LAYOUT.text(self)}'.rstrip()


def message_class(name: str, type_: int, layout: str, values: Sequence[Value] = (),
                  label: str = '', doc: str = '') -> Any:
    """The class of a message that is a row.

    Args:
        name: of the class.
        type_: the message's type on the wire.
        layout, values: see `Layout`. Values are attributes of a message where their names can be.
        label: what the message is called in a line for people; `name` if empty.
    """
    # Not by the message's name, which may be a keyword of Python.
    fields = namedtuple('Values', [value.name for value in values], rename=True)
    return type(name, (Row, fields), {
        '__slots__': (), '__doc__': doc, 'TYPE': type_, 'LABEL': label or name,
        'LAYOUT': Layout(layout, values)})


def readable(text: str) -> str:
    """One line that harms no terminal."""
    return ''.join(c if c.isprintable() or category(c) == 'Zs' else '\N{REPLACEMENT CHARACTER}'
                   for c in text)
