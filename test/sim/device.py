"""A serial line in virtual time: the kernel's end, which the bridge has open, and a board's end."""
from collections import deque
from typing import Callable, Deque, List, NamedTuple, Optional, Tuple

from world import World

_PIECE = 16             # bytes that the line moves at once
_ROOM = 4095            # bytes that a tty or pty takes before it is full
_NETWORK_ROOM = 65536   # bytes, likewise, of a connection
_MOST_INPUT = 65536     # bytes that wait to be read; more are lost


class Chunk(NamedTuple):
    """Bytes at one place of the line."""

    time: float
    data: bytes


class Damage(NamedTuple):
    """How often a piece of bytes is damaged, in one direction."""

    flip: float = 0.0       # a bit is changed
    lose: float = 0.0       # some of its bytes are lost
    double: float = 0.0     # it comes twice

    def __call__(self, data: bytes, world: World) -> bytes:
        chance = world.random.random()
        at = world.random.randrange(len(data))
        if chance < self.flip:
            return data[:at] + bytes((data[at] ^ 1 << world.random.randrange(8),)) + data[at + 1:]
        if chance < self.flip + self.lose:
            return data[:at] + data[at + world.random.randint(1, 3):]
        if chance < self.flip + self.lose + self.double:
            return data + data
        return data


class Device:
    """One line. The bridge's end has the calls of a kernel, which raise OSError.

    Args:
        kind: `tty`; `pty` and `network` hide what they have not sent.
        baud: of a tty.
    """

    def __init__(self, world: World, kind: str, baud: int) -> None:
        self.kind = kind
        self.board_gets: List[Chunk] = []       # what reached the board
        self.bridge_wrote: List[Chunk] = []     # what the kernel took
        self.bridge_read: List[Chunk] = []      # what the bridge read
        self.board_sent: List[Chunk] = []       # before any damage
        self.openings: List[float] = []
        self.closings: List[float] = []
        self.flushes: List[float] = []          # of the output
        self.drops: List[float] = []            # likewise, with the input
        self.restorations: List[float] = []     # of the settings
        self.damage_sent = self.damage_received = Damage()
        self.hold = 0.0              # s; an adapter delivers input only every so often
        self.split = 0.0             # how often input arrives in two parts
        self.is_there = True         # it is plugged in
        # What happens inside the next `send` of such bytes, and whether before they are taken.
        self.in_write: Optional[Tuple[Callable[[], None], bool, Callable[[bytes], bool]]] = None
        self.is_altered = False      # another program changed its settings
        self.receive: Callable[[bytes], None] = lambda data: None    # by the board
        self.on_input: Callable[[], None] = lambda: None
        self.on_pulse: Callable[[], None] = lambda: None
        self._world = world
        self._byte_time = 10.0 / baud if kind == 'tty' else 0.0
        self._is_open = False
        self._number = 0             # of the opening: what was under way before it is lost
        self._output: Deque[bytes] = deque()
        self._is_pumping = False
        self._blocked_until = 0.0    # the far end takes nothing
        self._input = b''
        self._arriving: Deque[Tuple[bytes, int]] = deque()
        self._input_free = 0.0       # when the line has delivered what the board sent
        self._failure = ''           # the connection was reset

    # -- the kernel, for the bridge -------------------------------------------------------

    def open(self) -> None:
        if not self.is_there:
            raise FileNotFoundError(2, 'No such file or directory')
        self._is_open = True
        self._number += 1
        self._failure = ''
        self._input = b''
        self._output.clear()
        self.openings.append(self._world.clock())

    def close(self) -> None:
        self._is_open = False
        self._output.clear()
        self.closings.append(self._world.clock())

    def read(self, size: int) -> bytes:
        """What has been received, at most `size` bytes; b'': nothing."""
        self._check()
        data, self._input = self._input[:size], self._input[size:]
        if data:
            self.bridge_read.append(Chunk(self._world.clock(), data))
        return data

    def send(self, data: bytes) -> int:
        """Take as many bytes as there is room for; BlockingIOError: none."""
        self._check()
        happens, before, concerns = self.in_write or (None, False, lambda data: True)
        if happens and concerns(data):
            self.in_write = None
        else:
            happens = None
        if happens and before:
            happens()
        room = _NETWORK_ROOM if self.kind == 'network' else _ROOM
        taken = data[:room - sum(map(len, self._output))]
        if not taken:
            raise BlockingIOError
        self.bridge_wrote.append(Chunk(self._world.clock(), taken))
        self._output.append(taken)
        self._pump_later()
        if happens and not before:
            happens()
        return len(taken)

    def unsent(self) -> int:
        """The bytes that wait, as the kernel knows it."""
        return 0 if self.kind != 'tty' else sum(map(len, self._output))

    def flush_output(self) -> None:
        """Drop what waits. What the far end of a pty can read already stays."""
        self.flushes.append(self._world.clock())
        if self.kind == 'tty':
            self._output.clear()

    def drain(self, seconds: float) -> float:
        """Let what waits leave within `seconds`; return how long that takes."""
        waiting = self.unsent()
        if self._world.time < self._blocked_until:
            return seconds if waiting else 0.0
        took = min(seconds, waiting * self._byte_time)
        while waiting and self._output:
            self._pump_now()
        return took

    def renew(self, keeps_input: bool) -> int:
        """Drop what waits, and restore the settings; return how many bytes of input were dropped.
        """
        self.flush_output()
        if self.is_altered:
            self.is_altered = False
            self.restorations.append(self._world.clock())
        if keeps_input or self.kind == 'network':
            return 0
        self.drops.append(self._world.clock())
        dropped, self._input = len(self._input), b''
        return dropped

    def pulse(self) -> None:
        """Reset the board by a control line."""
        self.on_pulse()

    def _check(self) -> None:
        if not self._is_open or self._failure or not self.is_there:
            raise OSError(5, self._failure or 'Input/output error')

    # -- the line ---------------------------------------------------------------------------

    def from_board(self, data: bytes) -> None:
        """Bytes that the board sends now."""
        self.board_sent.append(Chunk(self._world.time, data))
        data = self.damage_received(data, self._world) if data else data
        if not data or not self._is_open:
            return
        start = max(self._world.time, self._input_free)
        self._input_free = start + len(data) * self._byte_time
        number = self._number
        cut = self._world.random.randrange(len(data)) \
            if self._world.random.random() < self.split else 0
        for part, arrives in ((data[:cut], start + cut * self._byte_time),
                              (data[cut:], self._input_free)):
            if self.hold:
                arrives = (arrives // self.hold + 1) * self.hold
            if part:
                self._arriving.append((part, number))
                self._world.at(arrives, self._arrive)

    def _arrive(self) -> None:
        data, number = self._arriving.popleft()     # in order, also of what arrives at once
        if number == self._number and self._is_open and self.is_there:
            self._input = (self._input + data)[:_MOST_INPUT]
            self.on_input()

    def _pump_later(self) -> None:
        if not self._is_pumping and self._output:
            self._is_pumping = True
            size = min(len(self._output[0]), _PIECE)
            start = max(self._world.time, self._blocked_until)
            self._world.at(start + max(size * self._byte_time, 2e-5), self._pump)

    def _pump(self) -> None:
        self._is_pumping = False
        if self._world.time >= self._blocked_until and self._output and self.is_there:
            self._pump_now()
        self._pump_later()

    def _pump_now(self) -> None:
        first = self._output.popleft()
        piece, rest = first[:_PIECE], first[_PIECE:]
        if rest:
            self._output.appendleft(rest)
        piece = self.damage_sent(piece, self._world)
        if piece:
            self.board_gets.append(Chunk(self._world.time, piece))
            self.receive(piece)

    # -- faults -----------------------------------------------------------------------------

    def block(self, seconds: float) -> None:
        """The far end takes nothing for so long."""
        self._blocked_until = max(self._blocked_until, self._world.clock() + seconds)

    def reset_connection(self) -> None:
        """The peer resets the connection."""
        self._failure = 'Connection reset by peer'
        self._output.clear()
        self.on_input()

    def unplug(self) -> None:
        """It is gone, with all that was under way."""
        self.is_there = False
        self._failure = 'Input/output error'    # also once it is back, until it is opened again
        self._output.clear()
        self._input = b''
        self.on_input()

    def plug(self) -> None:
        self.is_there = True
