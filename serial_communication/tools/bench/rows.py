"""What a message of one's own costs, from the board's bytes to those of a ROS message.

Beside one that is decoded and filled in by a class and lines of its own, with the same checks, as
each built-in was before they became rows. No ROS master: what rospy takes comes on top of each,
some ten times as much.
"""
import struct
import time
from io import BytesIO
from math import isfinite
from typing import Any, Callable, List, NamedTuple, Optional, Tuple

from serial_communication.msg import Voltage

from ...protocols import arduino, cobs
from ...protocols.framing import Frame
from ...ros.ros_fields import RosFields
from ...ros.rows import arduino_rows
from .figures import RowCost

_TYPE = 32
_COUNT = 1000         # messages a turn
_ROW = {'type': _TYPE, 'ros_type': 'serial_communication/Voltage', 'fields': ['value'],
        'minimum': 0, 'maximum': 100}


class _Volts(NamedTuple):
    """A float32 within 0 … 100, as a class of its own."""

    value: float

    @classmethod
    def unpack(cls, data: bytes) -> '_Volts':
        """From four bytes."""
        return tuple.__new__(cls, _STRUCT.unpack(data))

    def implausible(self) -> str:
        """Why it cannot be, or ''."""
        return '' if isfinite(self.value) and 0 <= self.value <= 100 else 'not within 0 to 100'


_STRUCT = struct.Struct('<f')


class _ByHand(arduino.Decoder):
    """Packets to classes of their own, without layouts and without constructors."""

    _classes = {_TYPE: _Volts}

    def _packet(self, encoded: bytes, stamp: Any) -> Optional[Frame]:
        raw = encoded + b'\0'
        packet = cobs.undo(encoded)
        if not packet or len(packet) > arduino.MAX_PACKET:
            return None
        type_, data = packet[0], packet[1:]
        message_class = self._classes.get(type_)
        if message_class is None or len(data) != _STRUCT.size:
            return None
        message = message_class.unpack(data)
        if type_ not in self._unchecked and message.implausible():
            return None
        return _good(raw, type_, data, message, stamp)


def _good(raw: bytes, type_: int, data: bytes, message: Any, stamp: Any) -> Frame:
    return tuple.__new__(Frame, (raw, type_, 0, data, message, stamp, '', ''))


def _sides() -> List[Tuple[str, Callable[[bytes], List[Frame]], Callable[[Any], Any], bytes]]:
    """What it is, its decoder, what fills a message of ROS in, and the layout."""
    by_hand = Voltage()

    def fill_by_hand(message: _Volts) -> Voltage:
        by_hand.value = message.value
        return by_hand

    built_in = RosFields(Voltage, arduino.Voltage.LAYOUT, 'voltage')
    ready = built_in.new()
    sides = [('a class of its own', _ByHand().feed, fill_by_hand, b'f'),
             ('a built-in row', arduino.Decoder().feed,
              lambda message: built_in.fill(ready, message), b'F')]
    for what, layout, scale in (("a row of one's own", '<f', 1),
                                ("a row of one's own, scaled", '<h', 0.01)):
        row, = arduino_rows({'row': dict(_ROW, layout=layout, scale=scale)})
        sides.append((what, arduino.Decoder(messages=[row.kind]).feed,
                      lambda message, row=row, out=row.fields.new(): row.fields.fill(out, message),
                      layout[1:].encode()))
    return sides


def _packets(kind: bytes) -> List[bytes]:
    """One message a read."""
    type_ = arduino.Voltage.TYPE if kind == b'F' else _TYPE
    return [cobs.encode(bytes((type_,)) + (
        struct.pack('<h', n) if kind == b'h' else struct.pack('<f', n / 100))) + b'\0'
        for n in range(_COUNT)]


def run(seconds: float) -> List[RowCost]:
    """Every way in turns for `seconds` in all."""
    sides = [(what, feed, fill, _packets(kind), [], []) for what, feed, fill, kind in _sides()]
    until = time.monotonic() + seconds
    while time.monotonic() < until or len(sides[0][4]) < 3:
        for _, feed, fill, packets, decoded, filled in sides:
            start = time.perf_counter()
            for data in packets:
                feed(data)
            middle = time.perf_counter()
            for data in packets:
                for frame in feed(data):
                    fill(frame.message).serialize(BytesIO())
            decoded.append(middle - start)
            filled.append(time.perf_counter() - middle)
    rows = []
    for what, _, _, _, decoded, filled in sides:
        # What else the machine does only ever adds to a time.
        costs = [min(times) / _COUNT * 1e6 for times in (decoded, filled)]
        rows.append(RowCost(what, costs[0], costs[1],
                            costs[1] / (rows[0].us_to_ros if rows else costs[1])))
    return rows
