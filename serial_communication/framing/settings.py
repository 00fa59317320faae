"""Settings, numbers of the firmware that change while it runs: their rows, and how they are sent.

    +----------------+-------+
    | number (uint8) | value |     to the board: use this value; from the board: it uses this value
    +----------------+-------+

Little-endian. Each link with settings has one type for them, `TYPE`.
"""
import re
import struct
from collections import namedtuple
from contextlib import suppress
from typing import Any, Dict, Iterable, List, NamedTuple, Tuple, Type

from .custom_messages import Row, RowError, rows
from .layout import FRACTIONS, Layout, LayoutMessage, Value

TYPE = 253               # message type (arduino), TYPE (mcu)
KEY = 'setting'          # a row with this key is a setting
_KEYS = (KEY, 'layout', 'minimum', 'maximum', 'unit', 'description')
_LAYOUT = re.compile('<[?bBhHiIf]')


class Setting(NamedTuple):
    """What a row describes."""

    name: str
    key: str               # of the row, as arduino/settings/kp
    setting: int           # its number on the wire
    layout: Layout         # of the number and the value
    minimum: float
    maximum: float
    description: str

    @property
    def number(self) -> Tuple[str, int]:
        """The key of its number on the wire, and that number."""
        return KEY, self.setting

    @property
    def custom(self) -> 'Setting':
        """Itself: see `AnnouncedRows`."""
        return self

    @property
    def unit(self) -> str:
        """Of the value."""
        return self.layout.values[1].unit

    @property
    def code(self) -> str:
        """Struct's code of the value."""
        return self.layout.values[1].code

    @property
    def default(self) -> Any:
        """The allowed value that is nearest to 0, in place of one that is not known."""
        return self.checked(min(max(0, self.minimum), self.maximum))

    def allowed(self) -> str:
        """The allowed values in words."""
        if self.code == '?':
            return 'may be true or false'
        kind = 'number' if self.code in FRACTIONS else 'whole number'
        least, most = self.layout.values[1].range
        low = '' if self.minimum == least else f' from {self.minimum:.10g}'
        high = '' if self.maximum == most else f' to {self.maximum:.10g}'
        return f'may be a {kind}{low}{high} {self.unit}'.rstrip()

    def checked(self, value: Any) -> Any:
        """The value as the board will have it, rounded to what its layout holds.

        Raises:
            ValueError: it is not allowed; the text says what is.
        """
        with suppress(struct.error, OverflowError):     # its place cannot hold it
            if type(value) in (bool, int, float) and self.minimum <= (
                    _shortest(value) if self.code in FRACTIONS else value) <= self.maximum:
                return SettingMessage.read(self.layout, self.layout.pack((self.setting, value)))[1]
        raise ValueError(self.allowed())


def read_settings(entries: Any, key: str) -> List[Setting]:
    """The settings of a board.

    Args:
        entries: the rows, by name.
        key: their parameter, as ``arduino/settings``.

    Raises:
        RowError: a row cannot be used; the first of them is reported.
    """
    settings: List[Setting] = []
    for name, row in rows(entries, key, _KEYS):
        if name == 'groups':     # dynamic_reconfigure has another meaning for it
            raise RowError(row.key, name, 'may not be the name of a setting')
        number = row.number(KEY, lambda n: 0 <= n <= 255, 'a whole number from 0 to 255',
                            whole=True)
        row.refuse_second(KEY, number, {other.setting: other.name for other in settings})
        code = row.text('layout', _LAYOUT, '< and one of ? b B h H i I f')[1:]
        if code == '?':
            row.refuse_unused(['minimum', 'maximum'], 'layout: <?')
        low, high = Value('', code=code).range
        minimum, maximum = _limits(row, code, low, high)
        value = Value(name, row.text('unit', None, 'text', ''))
        if code in FRACTIONS:      # NaN and infinity are implausible
            value = value._replace(minimum=low, maximum=high)
        settings.append(Setting(name, row.key, number,
                                Layout('<B' + code, [Value('number'), value]), minimum, maximum,
                                ' '.join(row.text('description', None, 'text', '').split())))
    return settings


def _limits(row: Row, code: str, low: float, high: float) -> List[float]:
    """The minimum and the maximum of a row whose place holds `low` to `high`."""
    is_float = code in FRACTIONS
    may_be = f'a {"" if is_float else "whole "}number from {low:.10g} to {high:.10g}'
    minimum, maximum = [
        (float if is_float else int)(row.number(
            key, lambda n: low <= n <= high and (is_float or n == int(n)), may_be, default))
        for key, default in (('minimum', low), ('maximum', high))]
    if minimum > maximum:
        raise RowError(row.name('minimum'), minimum, f'may be at most the maximum, {maximum:g}')
    if is_float:     # `checked` rounds to a float32: also what it makes of a limit is allowed
        minimum, maximum = min(minimum, _shortest(minimum)), max(maximum, _shortest(maximum))
    return [minimum, maximum]


class SettingMessage(LayoutMessage, namedtuple('SettingMessage', 'number value')):
    """A setting's number and its value; without a row, the value is a tuple of its bytes."""

    __slots__ = ()
    TYPE = TYPE
    LABEL = 'setting'
    LAYOUT = Layout('<BB*', [Value('number'), Value('value')])
    ROWS: Dict[int, Setting] = {}     # by number

    @classmethod
    def layout_of(cls, data: bytes) -> Layout:
        row = cls.ROWS.get(data[0]) if data else None
        return row.layout if row else cls.LAYOUT

    @classmethod
    def unpack(cls, data: bytes) -> 'SettingMessage':
        """From the data; struct.error if it has the wrong length."""
        return tuple.__new__(cls, cls.read(cls.layout_of(data), data))

    @staticmethod
    def read(layout: Layout, data: bytes) -> Tuple[int, Any]:
        """The number and the value of the data, a float with as few digits as it needs: 2.2."""
        number, value = layout.unpack(data)
        return number, _shortest(value) if isinstance(value, float) else value

    @property
    def _layout(self) -> Layout:
        return self.layout_of(bytes((self.number,)))

    def pack(self) -> bytes:
        """The data; ValueError for a value that its place cannot hold."""
        return self._layout.pack(self)

    def implausible(self) -> str:
        return self._layout.implausible(self)

    def __str__(self) -> str:
        return f'{self.LABEL} {self._layout.text(self)}'


def message_of(settings: Iterable[Setting]) -> Type[SettingMessage]:
    """The message class of these settings, for decoders."""
    return type('SettingMessage', (SettingMessage,), {
        '__slots__': (), 'ROWS': {row.setting: row for row in settings}})


def _shortest(number: float) -> float:
    """The decimal number with the fewest digits that is the same float32 as this number."""
    wanted = struct.pack('<f', number)
    number, = struct.unpack('<f', wanted)
    return next((short for short in (float(f'{number:.{digits}g}') for digits in (6, 7, 8))
                 if abs(short) < 3.4e38 and struct.pack('<f', short) == wanted), number)
