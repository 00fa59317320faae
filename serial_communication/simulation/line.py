"""The line between a simulated board and its port: faults, the line's speed, the journal.

Frames leave in the order in which they were sent, as on any serial line: a delayed frame delays
all frames behind it.
"""
import math
from collections import deque
from dataclasses import dataclass
from typing import Any, Callable, Deque, NamedTuple, Optional

from ..transport.port import PortBusy, PortError
from .faults import Faults
from .journal import Journal

_PIECE = 16            # bytes that are written at once where the line has a speed
_MOST_WAITING = 65536  # bytes; with more in the queue a frame is lost
_RECENT = 70000        # bytes of input that `is_unaltered` knows: more than the longest frame


class _Output(NamedTuple):
    """Bytes to write: a frame, or a piece of one where the line has a speed."""

    ready: float            # when to write them
    data: bytes
    event: str              # for the journal; '': not the last piece
    fields: dict


@dataclass
class _Leaving:
    """A frame that is being written, piece by piece."""

    findable: bool         # whether the bytes before it let a decoder find it
    whole: bool = True     # whether no piece of it was lost


class SimulatedLine:
    """One board's line. All times are seconds of one monotonic clock, passed in as `now`.

    Args:
        board: gets this object as its ``line``.
        write: writes bytes to the port; raises PortBusy or PortError if it cannot.
        faults: None: no faults.
        journal: None: no journal.
        say: called with lines for people.
        baud: the speed of the line, 8N1; 0: as fast as the port takes the bytes.
    """

    def __init__(self, board: Any, write: Callable[[bytes], None],
                 faults: Optional[Faults] = None, journal: Optional[Journal] = None,
                 say: Callable[[str], None] = lambda text: None, baud: int = 0) -> None:
        self.board = board
        self.faults = faults or Faults()
        self.sends_time = self.faults.drift is not None
        self.frames = 0                # sent by the board, those that faults lost included
        self._write = write
        self._journal = journal
        self.say = say
        self._byte_time = 10.0 / baud if baud else 0.0
        self._now = 0.0
        self._powered_at = 0.0         # when the board was switched on, or reset
        self._queue: Deque[_Output] = deque()
        self._waiting = 0              # bytes in the queue
        self._free = 0.0               # when the queue is empty
        self._last = b''               # the last byte written; b'': none since the port opened
        self._leaving: Optional[_Leaving] = None   # a frame that is written in part
        self._silent_until = 0.0
        self._stalled_until = 0.0
        self._up_at: Optional[float] = None    # when a reset ends; None: there is none now
        self._recent = b''
        board.line = self

    # -- for the runner -----------------------------------------------------------------

    def start(self, now: float) -> None:
        """Switch the board on."""
        self._now = now
        self.faults.start(now)
        self._power_on(now)

    def opened(self, now: float) -> None:
        """The port was opened."""
        self._now = now
        self._last = b''
        self.note('port', open=True)

    def closed(self, now: float) -> None:
        """The port was closed: the queue is lost."""
        self._now = now
        while self._queue:
            self._put(self._queue.popleft(), 'closed')
        self._free = now
        self.note('port', open=False)

    def receive(self, data: bytes, now: float) -> None:
        """Pass received bytes to the board, after the faults."""
        self._now = now
        if self._up_at is not None:
            self.note('rx-lost', data=data.hex(), why='reset')
            return
        if self.faults.on_input:
            begun = self.board.decoder is not None and self.board.decoder.begun
            self._recent = (self._recent + data)[-_RECENT:] if begun else data
            given = data
            data, faults = self.faults.received(given, now)
            if faults:
                self.note('rx-fault', faults=faults, came=given.hex(), became=data.hex())
        if data:
            self.board.receive(data, now)

    def tick(self, now: float) -> Optional[float]:
        """Do what is due, write what is ready; return when to be called next at the latest."""
        self._now = now
        for kind, seconds in self.faults.events(now):
            self.begin(kind, seconds, now)
        if self._up_at is not None and now >= self._up_at:
            self._up_at = None
            self._power_on(now)
        times = [self.board.tick(now) if self._up_at is None else self._up_at,
                 self.faults.next_event()]
        if self.stalled(now):
            times.append(self._stalled_until)
        while self._queue and self._queue[0].ready <= now:
            self._put(self._queue.popleft())
        if self._queue:
            times.append(self._queue[0].ready)
        if self._journal is not None:
            times.append(self._journal.flush_due(now))
        return min((time for time in times if time is not None), default=None)

    def stalled(self, now: float) -> bool:
        """Whether a fault keeps the board from reading the port."""
        return now < self._stalled_until

    # -- for the board ------------------------------------------------------------------

    def send(self, frame: bytes, fields: dict) -> None:
        """Send a frame; `fields` describe it in the journal."""
        self.frames += 1
        sending = self.faults.sent(frame, self._now)
        fields = dict(fields, n=self.frames)
        if sending.faults:
            fields['faults'] = list(sending.faults)
        if self._now < self._silent_until:
            self._lost(fields, 'silence')
        elif not sending.wire:
            self._lost(fields, 'drop')
        elif self._waiting > _MOST_WAITING:
            self._lost(fields, 'busy')
        else:
            if sending.wire == frame + frame or sending.repeat_after:
                fields['copies'] = 2
            elif sending.wire != frame:
                fields['wire'] = sending.wire.hex()
            ready = self._now + sending.delay
            self._enqueue(sending.wire, ready, 'tx', fields)
            if sending.repeat_after:
                self._enqueue(sending.wire, ready + sending.repeat_after, 'copy',
                              {'n': self.frames})

    def micros(self) -> int:
        """The board's clock: µs since it was switched on, modulo 2 ** 32."""
        pace = 1e6 + (self.faults.drift or 0.0)
        return round((self._now - self._powered_at) * pace) % 2 ** 32

    def send_raw(self, data: bytes) -> None:
        """Send bytes that are not a frame."""
        if self._now >= self._silent_until:
            self._enqueue(data, self._now, 'chatter', {'wire': data.hex()})

    def note(self, event: str, **fields: Any) -> None:
        """Write a line to the journal, if there is one."""
        if self._journal is not None:
            self._journal.write(self._now, event, fields)

    def is_unaltered(self, raw: bytes) -> bool:
        """Whether a received frame is as the bridge sent it, not made by a fault on the way."""
        return not self.faults.on_input or raw in self._recent

    # -- inside -------------------------------------------------------------------------

    def _power_on(self, now: float) -> None:
        self.note('boot')
        self._powered_at = now
        self.board.power_on(now)

    def begin(self, kind: str, seconds: float, now: float) -> None:
        """Begin a silence, a stall or a reset."""
        self._now = now
        self.note('fault', kind=kind, seconds=round(seconds, 3))
        if kind == 'silence':
            self._silent_until = max(self._silent_until, now + seconds)
            self.say(f'fault: silent for {seconds:.1f} s')
        elif kind == 'stall':
            self._stalled_until = max(self._stalled_until, now + seconds)
            self.say(f'fault: reads nothing for {seconds:.1f} s')
        else:
            self.say(f'fault: reset, up again in {seconds:.1f} s')
            if self._up_at is None:
                self.board.power_off(now)
            self._up_at = now + seconds
            self.send_raw(self.board.CHATTER)

    def _lost(self, fields: dict, why: str) -> None:
        self.note('tx', **dict(fields, ok=False, sent=False, why=why))

    def _enqueue(self, wire: bytes, ready: float, event: str, fields: dict) -> None:
        start = self._free = max(ready, self._free)
        batch = self.faults.batch
        pieces = [wire]
        if self._byte_time:
            pieces = [wire[at:at + _PIECE] for at in range(0, len(wire), _PIECE)]
        for index, piece in enumerate(pieces):
            self._free = start = start + len(piece) * self._byte_time
            last = index == len(pieces) - 1
            out_at = start if not batch else math.ceil(start / batch) * batch
            self._queue.append(_Output(out_at, piece, event if last else '', fields))
        self._waiting += len(wire)
        if len(self._queue) == 1 and self._queue[0].ready <= self._now:
            self._put(self._queue.popleft())

    def _put(self, output: _Output, why: str = '') -> None:
        self._waiting -= len(output.data)
        if self._leaving is None:
            delimiter = self.board.DELIMITER
            self._leaving = _Leaving(not delimiter or self._last in (b'', delimiter))
        frame = self._leaving
        if not why:
            try:
                self._write(output.data)
                self._last = output.data[-1:]
            except PortBusy:
                why = 'busy'
            except PortError:
                why = 'closed'
        if why:
            frame.whole = False
        if not output.event:
            return
        self._leaving = None
        fields = output.fields
        if output.event == 'tx':
            intact = frame.whole and 'wire' not in fields
            fields['ok'] = intact and frame.findable
            if intact and not frame.findable:
                fields['behind_damage'] = True
        if not frame.whole:
            fields.update(sent=False, why=why or 'busy')
        self.note(output.event, **fields)
