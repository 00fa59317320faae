"""Settings, numbers of the firmware that change while it runs: how they are sent.

    +----------------+-------+
    | number (uint8) | value |     to the board: use this value; from the board: it uses this value
    +----------------+-------+

Little-endian. Each link with settings has one type for them, `TYPE`.
"""
from collections import namedtuple
from typing import Dict, Iterable, Type

from .layout import Layout, LayoutMessage, Value, shortest
from .rows import Setting

TYPE = 253               # message type (arduino), TYPE (mcu)


class SettingMessage(LayoutMessage, namedtuple('SettingMessage', 'number value')):
    """A setting's number and its value; without a row, the value is a tuple of its bytes."""

    __slots__ = ()
    TYPE = TYPE
    LABEL = 'setting'
    LAYOUT_WITHOUT_ROW = Layout('<BB*', [Value('number'), Value('value')])
    ROWS: Dict[int, Setting] = {}     # by number

    @classmethod
    def layout_of(cls, data: bytes) -> Layout:
        row = cls.ROWS.get(data[0]) if data else None
        return row.layout if row else cls.LAYOUT_WITHOUT_ROW

    @classmethod
    def unpack(cls, data: bytes) -> 'SettingMessage':
        """From the data; struct.error if it has the wrong length. A float has as few digits as it
        needs: 2.2."""
        number, value = cls.layout_of(data).unpack(data)
        return tuple.__new__(cls, (number, shortest(value) if isinstance(value, float) else value))

    @property
    def LAYOUT(self) -> Layout:     # type: ignore[override]  # each setting has its own
        return self.layout_of(bytes((self.number,)))


def message_of(settings: Iterable[Setting]) -> Type[SettingMessage]:
    """The message class of these settings, for decoders."""
    return type('SettingMessage', (SettingMessage,), {
        '__slots__': (), 'ROWS': {row.number: row for row in settings}})
