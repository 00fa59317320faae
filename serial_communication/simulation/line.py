"""What lies between a simulated board and its port: faults, the line's speed, the journal.

Frames leave in the order in which they were sent, as on any serial line: one that is held back
holds back all behind it.
"""
from collections import deque
from dataclasses import dataclass
from typing import Any, Callable, Deque, NamedTuple, Optional

from ..transport.port import PortBusy, PortError
from .faults import Faults
from .journal import Journal

_PIECE = 16            # bytes that cross the line at once where its speed counts
_MOST_WAITING = 65536  # bytes; what is held back longer than this is lost
_RECENT = 70000        # bytes of input that are kept for `came`: the longest frame


class _Output(NamedTuple):
    """Bytes on their way out: a frame, or with the line's speed a piece of one."""

    ready: float
    data: bytes
    event: str              # for the journal, with the last piece; else ''
    fields: dict


@dataclass
class _Leaving:
    """A frame on its way through the port, piece by piece."""

    findable: bool         # what left before it ended as it should
    whole: bool = True     # no piece of it was lost


class Line:
    """One board's line. All times are seconds of one monotonic clock, given as `now`.

    Args:
        board: its end; it gets this as its ``line``.
        write: takes bytes to the port; PortBusy or PortError if it cannot.
        faults: what goes wrong.
        journal: where all of it is written down.
        say: is called with a line for a person.
        baud: the speed to keep, 8 data bits and no parity; 0: as fast as the port takes it.
    """

    def __init__(self, board: Any, write: Callable[[bytes], None],
                 faults: Optional[Faults] = None, journal: Optional[Journal] = None,
                 say: Callable[[str], None] = lambda text: None, baud: int = 0) -> None:
        self.board = board
        self.faults = faults or Faults()
        self.frames = 0                # handed over, or lost on purpose
        self._write = write
        self._journal = journal
        self.say = say
        self._byte_time = 10.0 / baud if baud else 0.0
        self._now = 0.0
        self._queue: Deque[_Output] = deque()
        self._waiting = 0              # bytes in it
        self._free = 0.0               # when the last byte of the queue has left
        self._last = b''               # the last byte that left, b'': none since the port opened
        self._leaving: Optional[_Leaving] = None   # a frame of which a piece is still to leave
        self._silent_until = 0.0
        self._stalled_until = 0.0
        self._up_at: Optional[float] = None    # the board restarts and is up again then
        self._recent = b''
        board.line = self

    # -- for the runner -----------------------------------------------------------------

    def start(self, now: float) -> None:
        """Switch the board on."""
        self._now = now
        self.faults.start(now)
        self._power_on(now)

    def opened(self, now: float) -> None:
        """The port is open."""
        self._now = now
        self._last = b''
        self.note('port', open=True)

    def closed(self, now: float) -> None:
        """The port has closed: what was on its way is lost."""
        self._now = now
        while self._queue:
            self._put(self._queue.popleft(), 'closed')
        self._free = now
        self.note('port', open=False)

    def receive(self, data: bytes, now: float) -> None:
        """Bytes have come."""
        self._now = now
        if self._up_at is not None:
            self.note('rx-lost', data=data.hex(), why='reset')
            return
        if self.faults.on_input:
            begun = self.board.decoder is not None and self.board.decoder.begun
            self._recent = (self._recent + data)[-_RECENT:] if begun else data
            came = data
            data, faults = self.faults.received(came, now)
            if faults:
                self.note('rx-fault', faults=faults, came=came.hex(), became=data.hex())
        if data:
            self.board.receive(data, now)

    def tick(self, now: float) -> Optional[float]:
        """Do what is due, send what can go; return when to be called next at the latest."""
        self._now = now
        for kind, seconds in self.faults.events(now):
            self._begin(kind, seconds)
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
        """Whether nothing is to be read from the port."""
        return now < self._stalled_until

    # -- for the board ------------------------------------------------------------------

    def send(self, frame: bytes, fields: dict) -> None:
        """Put a frame on its way; `fields` tells the journal what it is."""
        self.frames += 1
        fate = self.faults.sent(frame, self._now)
        fields = dict(fields, n=self.frames)
        if fate.faults:
            fields['faults'] = list(fate.faults)
        if self._now < self._silent_until:
            self._lost(fields, 'silence')
        elif not fate.wire:
            self._lost(fields, 'drop')
        elif self._waiting > _MOST_WAITING:
            self._lost(fields, 'busy')
        else:
            if fate.wire == frame + frame or fate.repeat_after:
                fields['copies'] = 2
            elif fate.wire != frame:
                fields['wire'] = fate.wire.hex()
            self._enqueue(fate.wire, self._now + fate.delay, 'tx', fields)
            if fate.repeat_after:
                self._enqueue(fate.wire, self._now + fate.delay + fate.repeat_after, 'copy',
                              {'n': self.frames})

    def send_raw(self, data: bytes) -> None:
        """Put bytes that are no frame on their way."""
        if self._now >= self._silent_until:
            self._enqueue(data, self._now, 'chatter', {'wire': data.hex()})

    def note(self, event: str, **fields: Any) -> None:
        """A line for the journal, if there is one."""
        if self._journal is not None:
            self._journal.write(self._now, event, fields)

    def came(self, raw: bytes) -> bool:
        """Whether these bytes came from the port so, and not by a fault of ours."""
        return not self.faults.on_input or raw in self._recent

    # -- inside -------------------------------------------------------------------------

    def _power_on(self, now: float) -> None:
        self.note('boot')
        self.board.power_on(now)

    def _begin(self, kind: str, seconds: float) -> None:
        now = self._now
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
        pieces = [wire]
        if self._byte_time:
            pieces = [wire[at:at + _PIECE] for at in range(0, len(wire), _PIECE)]
        for index, piece in enumerate(pieces):
            self._free = start = start + len(piece) * self._byte_time
            last = index == len(pieces) - 1
            self._queue.append(_Output(start, piece, event if last else '', fields))
        self._waiting += len(wire)
        if len(self._queue) == 1 and start <= self._now:
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
