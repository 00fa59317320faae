"""Messages that a struct format describes, with a name, a scale and limits for each value.

A `Layout` unpacks, packs, checks and prints such a message.
`message_class` makes the class of a message from one: the simple messages of all links, and the
custom messages.
"""
import re
import struct
from collections import namedtuple
from math import inf, isfinite
from typing import Any, Callable, List, NamedTuple, Optional, Sequence, Tuple
from unicodedata import category

NUMBERS = 'bBhHiIlLqQefd?'     # struct's codes that hold one number each
FRACTIONS = 'efd'             # those of them for floats
FINITE = 'finite'             # in place of a code: of a field for any number that is finite
# The least and the greatest raw number of each code.
RANGES = {'?': (0, 1), 'e': (-65504.0, 65504.0), 'd': (-inf, inf), 's': (-inf, inf),
          FINITE: (-1.7976931348623157e308, 1.7976931348623157e308),
          'f': (-3.4028234663852886e38, 3.4028234663852886e38)}
for _code, _bits in zip('bhilq', (8, 16, 32, 32, 64)):
    RANGES[_code] = -2 ** (_bits - 1), 2 ** (_bits - 1) - 1
    RANGES[_code.upper()] = 0, 2 ** _bits - 1

_NEAR = 0.01        # raw steps; a whole raw number that is nearer to a limit is at the limit

BOARD_TIME = '@time'          # the name of the value that is the board's time: see `Frame.ticks`

# The value of a raw number that means "no value": a NaN, told from others by its identity.
NO_VALUE = float('nan')


class Value(NamedTuple):
    """One value of a message: value = raw * scale + offset."""

    name: str                  # '': left out when received, packed as 0
    unit: str = ''
    scale: float = 1
    offset: float = 0
    minimum: float = -inf      # of the value, not of the raw number
    maximum: float = inf
    invalid: Optional[float] = None    # the raw number that means "no value"; None: there is none
    # Its place in the data, filled in by the `Layout` that has it:
    code: str = ''             # struct's code; 's': a text
    start: int = 0             # index of its first byte
    end: int = 0               # index after its last byte; -1: it extends to the end of the data

    @property
    def kind(self) -> str:
        """'number', 'array' (of numbers) or 'text'."""
        return 'text' if self.code == 's' else 'number' if self.end >= 0 else 'array'

    @property
    def is_scaled(self) -> bool:
        """Whether the value differs from the raw number. Without a scale an int stays an int."""
        return self.scale != 1 or self.offset != 0

    @property
    def is_limited(self) -> bool:
        """Whether some numbers are outside its limits; a text has none."""
        return self.code != 's' and (self.minimum > -inf or self.maximum < inf)

    @property
    def is_whole(self) -> bool:
        """Whether the value is always a whole number, or an array of them."""
        return self.code not in FRACTIONS + 's' and (
            not self.is_scaled or isinstance(self.scale, int) and isinstance(self.offset, int))

    @property
    def range(self) -> Tuple[float, float]:
        """The least and the greatest value that its place can hold; infinite for a text."""
        low, high = sorted(raw * self.scale + self.offset for raw in RANGES[self.code])
        return low, high

    @property
    def limits(self) -> Tuple[float, float]:
        """The least and the greatest value that is plausible: `minimum` and `maximum`, and what a
        float, or the scale, makes of them."""
        digits = {'e': 11, 'f': 24, 'd': 24}.get(self.code)     # a ROS field may be a float32
        slack = [_NEAR * abs(self.scale) if digits is None else
                 (abs(limit) + abs(self.offset)) * 2.0 ** -digits
                 for limit in (self.minimum, self.maximum)]
        return self.minimum - slack[0], self.maximum + slack[1]

    def holds(self, raw: float) -> bool:
        """Whether its place can hold exactly this raw number."""
        try:
            number = raw if self.code in FRACTIONS else int(raw)
            return bool(struct.unpack('<' + self.code, struct.pack('<' + self.code, number))
                        == (raw,))
        except (struct.error, OverflowError):
            return False

    def scaled(self, raw: Any) -> Any:
        """The value of a raw number, or of each number in a tuple; a text stays as it is."""
        if isinstance(raw, tuple):
            return tuple([self.scaled(each) for each in raw])
        if raw == self.invalid:
            return NO_VALUE
        return raw if isinstance(raw, str) or not self.is_scaled else \
            raw * self.scale + self.offset

    def packed(self, given: Any, order: str) -> bytes:
        """The data of a value, in the byte order '<' or '>'. One that its place cannot hold raises
        any of the errors that `Layout.pack` catches."""
        if self.code == 's':
            text = given.encode()
            if b'\0' in text or 0 <= self.end < self.start + len(text):
                raise ValueError
            return text
        numbers = (given,) if self.end > 0 else given
        return struct.pack(f'{order}{len(numbers)}{self.code}', *map(self._raw, numbers))

    def _raw(self, number: Any) -> Any:
        """The raw number that is nearest to a value."""
        if number is NO_VALUE and self.invalid is not None:
            return self.invalid if self.code in FRACTIONS else int(self.invalid)
        if self.is_scaled:
            number = (number - self.offset) / self.scale
        return number if self.code in FRACTIONS + '?' else round(number)

    def why_implausible(self, given: Any, low: float, high: float, takes_nan: bool = False) -> str:
        """Why a value, or one number of an array, is outside these limits; '' if it is not.

        Args:
            takes_nan: NaN and infinities are inside.
        """
        for number in given if isinstance(given, tuple) else (given,):
            if not (low <= number <= high or number is NO_VALUE
                    or takes_nan and not isfinite(number)):
                least, most = max(low, self.minimum), min(high, self.maximum)
                return f'{self.name} is {number:.6g}, out of range ' \
                       f'({least:g} … {most:g}{" " * bool(self.unit)}{self.unit})'
        return ''


class Layout:
    """A struct format with its values.

    Args:
        layout: a format of the struct module that begins with ``<`` or ``>``. A last ``*``
            repeats the character before it to the end of the data, as one value, a tuple. A last
            ``s`` without a number is a text to the end of the data or its first 0x00. Texts are
            UTF-8.
        values: one for each value in the format.
        fields: struct's codes of the ROS fields that have to hold the values; '' holds any.

    Raises:
        ValueError: the format is invalid.
    """

    def __init__(self, layout: str, values: Sequence[Value], fields: Sequence[str] = ()) -> None:
        fixed, rest, places = places_of(layout)
        self.layout = layout
        self.values = tuple([value._replace(code=code, start=start, end=end)
                             for value, (code, start, end) in zip(values, places)])
        self._struct = struct.Struct(fixed)
        self.size = self._struct.size      # bytes of data, at least
        # Bytes of one more number or character in the last value; 0: the size is fixed.
        self._step = struct.calcsize(layout[0] + rest) if rest else 0
        self._scaled = [(index, value) for index, value in enumerate(self.values)
                        if value.is_scaled or value.invalid is not None]
        # The index of each limited value, its limits, and whether it may be NaN.
        self._limited: List[Tuple[int, float, float, bool]] = []
        for index, (value, field) in enumerate(zip(self.values, fields or [''] * len(places))):
            least, most = RANGES[field] if field else (-inf, inf)
            low, high = value.limits
            is_wide = value.range[0] < least or value.range[1] > most \
                or value.code in FRACTIONS and bool(field) and field not in FRACTIONS
            if is_wide:      # what is rounded to `most` may be greater; a float of 2 ** 63 may not
                low = max(low, least - 0.5)
                high = min(high, most if most > 2 ** 53 else most + 0.49)
            if is_wide or value.is_limited:
                self._limited.append((index, low, high,
                                      field in FRACTIONS and not value.is_limited))
        # Called for every packet, so it is struct's own function where that is enough.
        is_simple = all(value.kind == 'number' for value in self.values)
        self.raw: Callable[[bytes], Tuple] = self._struct.unpack if is_simple else self._raw
        self.unpack: Callable[[bytes], Tuple] = self._unpack if self._scaled else self.raw

    @property
    def is_empty(self) -> bool:
        """Whether such a message has no data."""
        return not self.size and not self.values

    def fits(self, size: int) -> bool:
        """Whether such a message may have so many bytes of data."""
        more = size - self.size
        return more >= 0 and more % self._step == 0 if self._step else more == 0

    def sizes(self) -> str:
        """How many bytes of data it may have, in words."""
        return f'{self.size}' + f' and a multiple of {self._step}' * bool(self._step)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Layout) and (self.layout, self.values) == (
            other.layout, other.values)

    def __hash__(self) -> int:
        return hash(self.layout)

    def _unpack(self, data: bytes) -> Tuple:
        """The general `unpack`: the values; struct.error if `data` has the wrong length."""
        values = list(self.raw(data))
        for index, value in self._scaled:
            values[index] = value.scaled(values[index])
        return tuple(values)

    def _raw(self, data: bytes) -> Tuple:
        """The general `raw`: raw numbers and texts; struct.error if `data` has the wrong length."""
        if not self.fits(len(data)):
            raise struct.error(f'{len(data)} bytes of data, not {self.sizes()}')
        raw = self._struct.unpack_from(data)
        if self._step:
            rest, code = data[self.size:], self.values[-1].code
            raw += (rest if code == 's' else struct.unpack(
                f'{self.layout[0]}{len(rest) // self._step}{code}', rest),)
        return tuple([each.split(b'\0', 1)[0].decode('utf-8', 'replace')
                      if isinstance(each, bytes) else each for each in raw])

    def pack(self, values: Sequence) -> bytes:
        """The data of these values.

        Raises:
            ValueError: a value that its place cannot hold.
        """
        data = bytearray(self.size)
        for given, value in zip(values, self.values):
            try:
                packed = value.packed(given, self.layout[0]) if value.name else b''
            except (struct.error, OverflowError, TypeError, ValueError, AttributeError):
                raise ValueError(f'{value.name} is {brief(given, 40)}, which its place '
                                 f'({value.code}) cannot hold') from None
            data[value.start:value.start + len(packed)] = packed
        return bytes(data)

    def implausible(self, values: Sequence) -> str:
        """Why one of these values is outside its limits; '' if none is."""
        for index, low, high, takes_nan in self._limited:
            given = values[index]
            if isinstance(given, tuple) or not low <= given <= high:
                reason = self.values[index].why_implausible(given, low, high, takes_nan)
                if reason:
                    return reason
        return ''

    def text(self, values: Sequence) -> str:
        """The values in one line, as NAME=VALUE UNIT; the name ``value`` is left out."""
        return ' '.join(('' if value.name == 'value' else value.name + '=')
                        + words(given, value.unit)
                        for given, value in zip(values, self.values) if value.name)


def places_of(layout: str, longest: float = inf) -> Tuple[str, str, List[Tuple[str, int, int]]]:
    """The format without what extends to the end of the data; the code of that, or ''; and the
    code, start and end of each value: see `Value`.

    Raises:
        ValueError: it is invalid, or has over `longest` bytes: a few characters can describe more
            values than memory holds.
    """
    if layout[:1] not in ('<', '>'):
        raise ValueError('it does not begin with < or >')
    fixed, rest = layout.replace(' ', ''), ''
    if fixed.endswith('*'):
        fixed, rest = fixed[:-2], fixed[-2:-1]
    elif fixed.endswith('s') and not fixed[-2:-1].isdigit():
        fixed, rest = fixed[:-1], 's'
    try:
        size = struct.calcsize(fixed)
    except struct.error as error:
        raise ValueError(f'struct refuses it: {error}') from None
    if size > longest:
        raise ValueError(f'it has {size} bytes, there may be {longest}')
    places, at = [], 0
    for number, code in re.findall(r'(\d*)(\S)', fixed[1:]):
        count, each = int(number or 1), struct.calcsize(fixed[0] + code)
        if code == 's':
            places.append((code, at, at + count))
        elif code in NUMBERS:
            places += [(code, at + index * each, at + (index + 1) * each)
                       for index in range(count)]
        elif code != 'x':
            raise ValueError(f'{code} holds no number or text')
        at += count * each
    if rest not in ('', 's', *NUMBERS):
        raise ValueError(f'a * repeats one of {NUMBERS}')
    return fixed, rest, places + [(rest, size, -1)] * bool(rest)


def words(given: Any, unit: str) -> str:
    """A value with its unit, for people."""
    if isinstance(given, str):
        return repr(readable(given))
    if isinstance(given, tuple):
        text = '[' + ' '.join(words(number, '') for number in given) + ']'
    elif given is NO_VALUE:
        return 'none'
    elif isinstance(given, bool):
        text = str(given).lower()
    else:
        text = f'{given:.6g}' if isinstance(given, float) else str(given)
    return f'{text} {unit}'.rstrip()


def brief(given: Any, most: int) -> str:
    """`repr` of a value, cut to `most` characters."""
    words = repr(given)
    return words if len(words) <= most else words[:most - 1] + '…'


def shortest(number: float) -> float:
    """The decimal number with the fewest digits that is the same float32."""
    wanted = struct.pack('<f', number)
    number, = struct.unpack('<f', wanted)
    return next((short for short in (float(f'{number:.{digits}g}') for digits in (6, 7, 8))
                 if abs(short) < 3.4e38 and struct.pack('<f', short) == wanted), number)


EMPTY = Layout('<', ())


class LayoutMessage(tuple):
    """Base of the messages that a layout describes: a message is a tuple of its values. `framing`
    explains the members."""

    __slots__ = ()
    TYPE: int
    LABEL: str
    LAYOUT: Layout
    ANNOUNCED = False      # the board announces this message itself
    NUMBER = b''           # of a setting: the first byte of its data
    TICKS_AT: Optional[int] = None     # index of its value `BOARD_TIME`; None: it has none

    @classmethod
    def unpack(cls, data: bytes) -> Any:
        return tuple.__new__(cls, cls.LAYOUT.unpack(data))

    def pack(self) -> bytes:
        return self.LAYOUT.pack(self)

    def implausible(self) -> str:
        return self.LAYOUT.implausible(self)

    def __str__(self) -> str:
        return f'{self.LABEL} {self.LAYOUT.text(self)}'.rstrip()


def message_class(name: str, type_: int, layout: str, values: Sequence[Value] = (),
                  label: str = '', doc: str = '') -> Any:
    """Make the class of a message that a layout describes.

    Args:
        name: of the class.
        type_: the message's type on the wire.
        layout, values: see `Layout`. A value is an attribute of the message if its name is a
            valid identifier.
        label: the message's name for people; `name` if empty.
    """
    # Not `name`, which may be a keyword of Python.
    names = [value.name for value in values]
    fields = namedtuple(  # type: ignore[misc]  # mypy wants the names in the source
        'Values', names, rename=True)
    return type(name, (LayoutMessage, fields), {
        '__slots__': (), '__doc__': doc, 'TYPE': type_, 'LABEL': label or name,
        'LAYOUT': Layout(layout, values),
        'TICKS_AT': names.index(BOARD_TIME) if BOARD_TIME in names else None})


def readable(text: str) -> str:
    """`text` in one line that is safe to print: control characters are replaced."""
    return ''.join(c if c.isprintable() or category(c) == 'Zs' else '\N{REPLACEMENT CHARACTER}'
                   for c in text)
