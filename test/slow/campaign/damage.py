"""Damage on the lines that leaves no valid frame but those that were sent."""
import random
import re
from typing import List

import by_definition as codec
from .boards import ALIVE, COUNTER, SCAN

_LONGEST = 2200          # bytes: no frame spans more
_NOISE = 1, 2, 3, 8, 20, 60      # bytes
_CAR_LENGTHS = {codec.STEERING_ANGLE: 2, codec.TICKS: 1, codec.IMU: 22, codec.VOLTAGE: 4,
                COUNTER: 4, ALIVE: 0}


class DamagedLine:
    """One direction of a line, on which this `share` of the frames is damaged.

    Damage is drawn again until no valid frame ends in it but those that were sent, wherever in the
    latest bytes a decoder begins.
    """

    def __init__(self, frame_at: codec.FrameAt, rand: random.Random, share: float) -> None:
        self._frame_at, self._random, self._share = frame_at, rand, share
        self._is_car = frame_at is codec.arduino_at
        self._starts = re.compile(b'\x02' if frame_at is codec.mcu_at else b'[\xA5\x5A]')
        self.damaged = 0         # frames
        self.reset()

    def reset(self) -> None:
        """The line was plugged in again."""
        # The latest bytes; of the car those since the last 0x00, and where each write began.
        self._before, self._writes = b'', []    # type: bytes, List[int]

    @property
    def is_open(self) -> bool:
        """Whether a packet of the car has lost its 0x00, so the next one is lost, too."""
        return self._is_car and self._before != b''

    def pass_on(self, data: bytes, may_damage: bool = True) -> bytes:
        """Return what arrives of one frame."""
        received = data
        if may_damage and self._random.random() < self._share:
            received = damage(data, self._random)
        while self._has_foreign_frame(received, received == data):
            received = damage(data, self._random)
        self.damaged += received != data
        self._keep(received)
        return received

    def _keep(self, received: bytes) -> None:
        writes = [*self._writes, len(self._before)]
        self._before += received
        cut = self._before.rfind(b'\0') + 1 if self._is_car else max(
            0, len(self._before) - _LONGEST)
        self._before = self._before[cut:]
        self._writes = [at - cut for at in writes if at >= cut] if self._is_car else []

    def _has_foreign_frame(self, received: bytes, is_intact: bool) -> bool:
        end, stream = len(self._before), self._before + received
        if self._is_car:        # a decoder begins at a write if it has given up those before
            starts = [0, *self._writes, *(match.end() for match in re.finditer(b'\0', stream)), end]
        else:
            starts = [match.start() for match in self._starts.finditer(stream)]
        for at in starts:
            found = self._frame_at(stream, at) if at < len(stream) else None
            if isinstance(found, codec.Frame) and found.end > end and not (
                    is_intact and at >= end) and not self._is_harmless(found):
                return True
        return False

    def _is_harmless(self, frame: codec.Frame) -> bool:
        """Whether a packet of the car has an unknown type, or not the length of its type."""
        return self._is_car and frame.type > 3 and frame.type != SCAN \
            and len(frame.data) != _CAR_LENGTHS.get(frame.type)


def damage(data: bytes, rand: random.Random) -> bytes:
    """Flip a bit, remove bytes or insert noise."""
    at = rand.randrange(len(data))
    noise = bytes(rand.choice((0xA5, 0x5A, 0x02, 0x03, 0x00, rand.randrange(256)))
                  for _ in range(rand.choice(_NOISE)))
    return data[:at] + rand.choice((
        bytes((data[at] ^ 1 << rand.randrange(8),)) + data[at + 1:],
        data[at + rand.randrange(1, 4):], noise + data[at:]))
