"""Messages that a struct format describes, with a name, a scale and limits for each value.

A `Layout` unpacks, packs, checks and prints such a message.
`message_class` makes the class of a message from one: the simple messages of all links, and the
custom messages.
"""
import re
import struct
from collections import namedtuple
from math import inf, isfinite
from typing import Any, Callable, Dict, List, NamedTuple, Optional, Sequence, Tuple
from unicodedata import category

NUMBERS = 'bBhHiIlLqQefd?'     # struct's codes that hold one number each
FRACTIONS = 'efd'             # those of them for floats
# The least and the greatest raw number of each code.
_RANGES = {'?': (0, 1), 'e': (-65504.0, 65504.0), 'd': (-inf, inf), 's': (-inf, inf),
           'f': (-3.4028234663852886e38, 3.4028234663852886e38)}
for _code, _bits in zip('bhilq', (8, 16, 32, 32, 64)):
    _RANGES[_code] = -2 ** (_bits - 1), 2 ** (_bits - 1) - 1
    _RANGES[_code.upper()] = 0, 2 ** _bits - 1

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
    def room(self) -> Optional[int]:
        """How many bytes its place has; None: all up to the end of the data."""
        return self.end - self.start if self.end >= 0 else None

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
        low, high = sorted(raw * self.scale + self.offset for raw in _RANGES[self.code])
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
        """The data of a value, in the byte order '<' or '>'.

        Raises:
            struct.error, OverflowError, TypeError, ValueError, AttributeError: its place cannot
                hold the value.
        """
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
        if not isinstance(number, (int, float)):
            raise TypeError
        if self.is_scaled:
            number = (number - self.offset) / self.scale
        if self.code == '?':
            if not isfinite(number):
                raise ValueError
            return number != 0
        return number if self.code in FRACTIONS else round(number)

    def why_implausible(self, given: Any, low: float, high: float) -> str:
        """Why a value, or one number of an array, is outside its `limits`; '' if it is not."""
        if not self.is_limited:
            return ''
        unit = f' {self.unit}'.rstrip()
        for number in given if isinstance(given, tuple) else (given,):
            if number is not NO_VALUE and not low <= number <= high:
                why = f'{self.name} is {number:.6g}, '
                if self.maximum == inf:
                    return f'{why}below the minimum of {self.minimum:g}{unit}'
                if self.minimum == -inf:
                    return f'{why}above the maximum of {self.maximum:g}{unit}'
                return f'{why}out of range ({self.minimum:g} … {self.maximum:g}{unit})'
        return ''


class Layout:
    """A struct format with its values.

    Args:
        layout: a format of the struct module that begins with ``<`` or ``>``. A last ``*``
            repeats the character before it to the end of the data, as one value, a tuple. A last
            ``s`` without a number is a text to the end of the data or its first 0x00. Texts are
            UTF-8.
        values: one for each value in the format.

    Raises:
        ValueError: the format is invalid, or it has another number of values.
    """

    def __init__(self, layout: str, values: Sequence[Value]) -> None:
        fixed, rest = _split(layout)
        places = _places(fixed, rest)
        if len(places) != len(values):
            raise ValueError(f'it has {len(places)} values, not {len(values)}')
        self.layout = layout
        self.values = tuple([value._replace(code=code, start=start, end=end)
                             for value, (code, start, end) in zip(values, places)])
        self._struct = struct.Struct(fixed)
        self.size = self._struct.size      # bytes of data, at least
        # Bytes of one more number or character in the last value; 0: the size is fixed.
        self._step = struct.calcsize(layout[0] + rest) if rest else 0
        self._scaled = [(index, value) for index, value in enumerate(self.values)
                        if value.is_scaled or value.invalid is not None]
        self._limited = [(index, *value.limits)
                         for index, value in enumerate(self.values) if value.is_limited]
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
        if not self._step:
            return f'{self.size}'
        return f'{self.size}, {self.size + self._step}, {self.size + 2 * self._step} …'

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Layout) and (self.layout, self.values) == (
            other.layout, other.values)

    def __hash__(self) -> int:
        return hash((self.layout, self.values))

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
            ValueError: a value that its place cannot hold, or the wrong number of values.
        """
        if len(values) != len(self.values):
            raise ValueError(f'{len(values)} values, not {len(self.values)}')
        data = bytearray(self.size)
        for given, value in zip(values, self.values):
            if not value.name:
                continue
            try:
                packed = value.packed(given, self.layout[0])
            except (struct.error, OverflowError, TypeError, ValueError, AttributeError):
                raise ValueError(f'{value.name} is {brief(given, 40)}, which its place '
                                 f'({value.code}) cannot hold') from None
            data[value.start:value.start + len(packed)] = packed
        return bytes(data)

    def pack_raw(self, raw: Sequence) -> bytes:
        """The data of raw numbers, for a layout of fixed size; struct.error as in struct."""
        return self._struct.pack(*raw)

    def implausible(self, values: Sequence) -> str:
        """Why one of these values is outside its limits; '' if none is."""
        for index, minimum, maximum in self._limited:
            given = values[index]
            if isinstance(given, tuple) or not minimum <= given <= maximum:
                reason = self.values[index].why_implausible(given, minimum, maximum)
                if reason:
                    return reason
        return ''

    def text(self, values: Sequence) -> str:
        """The values in one line, as NAME=VALUE UNIT; the name ``value`` is left out."""
        return ' '.join(('' if value.name == 'value' else value.name + '=')
                        + words(given, value.unit)
                        for given, value in zip(values, self.values) if value.name)


def _split(layout: str) -> Tuple[str, str]:
    """Split off the code of a last value that extends to the end of the data; '' if none does."""
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
        raise ValueError('a last * or s that extends to the end of the data has no number before '
                         'it')
    return fixed, rest


def _size(fixed: str) -> int:
    try:
        return struct.calcsize(fixed)
    except struct.error as error:
        raise ValueError(f'struct refuses it: {error}') from None


def _places(fixed: str, rest: str) -> List[Tuple[str, int, int]]:
    """The code, start and end of each value; see `Value`."""
    size = _size(fixed)
    places, at = [], 0
    for number, code in re.findall(r'(\d*)(.)', fixed[1:]):
        count, each = int(number or 1), struct.calcsize(fixed[0] + code)
        if code == 's':
            places.append((code, at, at + count))
        elif code in NUMBERS:
            places += [(code, at + index * each, at + (index + 1) * each)
                       for index in range(count)]
        elif code != 'x':
            raise ValueError(f'{code} holds no number or text')
        at += count * each
    return places + [(rest, size, -1)] * bool(rest)


def count_values(layout: str, longest: int) -> Optional[int]:
    """How many values a format has; None: it has over `longest` bytes of data, and a few characters
    can describe more values than memory holds. ValueError: it is invalid."""
    fixed, rest = _split(layout)
    return None if _size(fixed) > longest else len(_places(fixed, rest))


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
    try:
        words = repr(given)
    except ValueError:      # Python prints no integer of over 4300 digits
        words = f'{type(given).__name__} with too many digits'
    return words if len(words) <= most else words[:most - 1] + '…'


def shortest(number: float) -> float:
    """The decimal number with the fewest digits that is the same float32 as this number."""
    wanted = struct.pack('<f', number)
    number, = struct.unpack('<f', wanted)
    return next((short for short in (float(f'{number:.{digits}g}') for digits in (6, 7, 8))
                 if abs(short) < 3.4e38 and struct.pack('<f', short) == wanted), number)


EMPTY = Layout('<', ())


class LayoutMessage(tuple):
    """Base of the messages that a layout describes: a message is a tuple of its values.

    `framing` explains the members. The classes that `message_class` does not make also derive from
    a NamedTuple.
    """

    __slots__ = ()
    TYPE: int
    LABEL: str
    LAYOUT: Layout
    ANNOUNCED = False      # the board announces this message itself
    TICKS_AT: Optional[int] = None     # index of its value `BOARD_TIME`; None: it has none

    @classmethod
    def unpack(cls, data: bytes) -> Any:
        return tuple.__new__(cls, cls.LAYOUT.unpack(data))

    def pack(self) -> bytes:
        return self.LAYOUT.pack(self)

    def implausible(self) -> str:
        return self.LAYOUT.implausible(self)

    @classmethod
    def layout_of(cls, data: bytes) -> Layout:
        """The layout that these data should have."""
        return cls.LAYOUT

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


def by_type(*kinds: Any) -> Dict[int, Any]:
    """Message classes by their types: `TYPE`, or `TYPES` of a class with several.

    Raises:
        ValueError: two classes have the same type.
    """
    found: Dict[int, Any] = {}
    for kind in kinds:
        for type_ in getattr(kind, 'TYPES', None) or (kind.TYPE,):
            if type_ in found:
                raise ValueError(f'{found[type_].__name__} and {kind.__name__} have the same type, '
                                 f'{type_}')
            found[type_] = kind
    return found


def readable(text: str) -> str:
    """`text` in one line that is safe to print: control characters are replaced."""
    return ''.join(c if c.isprintable() or category(c) == 'Zs' else '\N{REPLACEMENT CHARACTER}'
                   for c in text)
