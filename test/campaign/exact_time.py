"""Board time, exactly: stamps of a car that sends its clock, over lines that hold bytes back."""
import contextlib
import itertools
import math
import struct
import time
from typing import List

import by_definition as codec
from processes import StageError
from .rig import UNTIL_PUBLISHED, Rig

_TIME = 254
_PERIOD, _NUMBER = 0.01, 300      # s between two measurements, and their number
_KNOWN = 200         # measurements until the bridge knows the clock; twice what it says
_WITHIN = 0.005                   # s
_DRIFT = 0.003


def _send(rig: Rig, batch: float, damaged: int, origin: int) -> List[float]:
    """Send TICKS behind TIME; return when each was measured, by time.time().

    Args:
        batch: s; the bytes are sent at each multiple of it; 0.0: at once.
        damaged: each of so many TIMEs has no count; 0: none. Half of a second, all is held back for
            0.2 s.
        origin: the board's clock at the beginning, in µs.
    """
    measured, began, ahead = [], time.monotonic(), time.time() - time.monotonic()
    for number in range(_NUMBER):
        at = began + number * _PERIOD
        time.sleep(max(0.0, (math.ceil(at / batch) * batch if batch else at) - time.monotonic()))
        at = at if batch else time.monotonic()
        if number == _KNOWN + 50:
            time.sleep(0.2)
        micros = round(origin + (at - began) * (1 + _DRIFT) * 1e6) % 2 ** 32
        is_damaged = damaged and number % damaged == 0
        rig.car.line.write(
            codec.arduino_packet(_TIME, struct.pack('<I' if is_damaged else '<IB', micros,
                                                    *([] if is_damaged else [1])))
            + codec.arduino_packet(codec.TICKS, bytes((number % 256,))))
        measured.append(at + ahead)
    return measured


def stamps(rig: Rig) -> None:
    """A clock that drifts, wraps, and begins again elsewhere; batches, damage, a stall."""
    never = rig.row('a stamp is never after the read')
    within = rig.row("with the board's time a stamp is within 5 ms of the measurement")
    reads: List[float] = []
    subscriber = rig.robot.subscribe_to_traffic(
        lambda frame: reads.append(frame.header.stamp.to_sec())
        if (frame.link, frame.direction, frame.type) == ('arduino', 0, codec.TICKS) else None)
    published = rig.robot.published['~ticks']
    rig.wait(lambda: rig.car.measure() or rig.wait_beats(0.02) or reads, 'serial_msg')
    for batch, damaged, origin, stalls in (
            (0.0, 0, 2 ** 32 - 2_500_000, False), (0.016, 7, 0, False), (0.016, 0, 2 ** 31, True)):
        rig.settle()
        if stalls:
            with rig.suspended():
                rig.sleep(0.5)
            rig.sleep(1.0)          # until nothing is dropped any more
        reads.clear()
        measured = _send(rig, batch, damaged, origin)
        with contextlib.suppress(StageError):
            rig.wait(lambda: min(len(published), len(reads)) >= _NUMBER, '', UNTIL_PUBLISHED)
        for number, (at, one, read) in enumerate(itertools.zip_longest(measured, published, reads)):
            if not never.check(at and one and read and one.key == number % 256,
                               f'{number} of {len(published)} and {len(reads)} is not published'):
                break
            text = f'{number}: measured {at:.4f}, read {read:.4f}, stamped {one.stamp:.4f}'
            never.check(one.stamp <= read + 1e-6, text)
            if damaged and number % damaged == 0:
                never.check(one.stamp == read, text)
            elif number >= _KNOWN:
                within.at_most(abs(one.stamp - at) * 1e3, _WITHIN * 1e3, 'ms', text)
    subscriber.unregister()


SERIAL = (stamps,)
