"""What every simulated board has, and the runner that drives one on a port."""
import argparse
import time
from typing import Any, Callable, Optional

from ..framing.frame_timer import FrameTimer
from ..framing.stream import Frame
from ..transport.opener import Opener
from ..transport.pace import set_priority
from ..transport.port import Port, PortError
from .line import Line

FRAME_TIMEOUT = 0.05     # s without a byte after which an incomplete frame is given up
_LATE = 0.01             # s; being woken later than this goes into the journal
_REALTIME_PRIORITY = 10  # below the bridge's heartbeat


def positive(text: str) -> float:
    """An option's number above 0.

    Raises:
        argparse.ArgumentTypeError: it is none.
    """
    value = float(text)
    if not 0 < value < float('inf'):
        raise argparse.ArgumentTypeError(f'{text} is not above 0')
    return value


class Board:
    """Base of the boards: a state machine in the time that it is given. No I/O, no clock.

    A subclass overrides the hooks, says what it is in the attributes below, and stands as `BOARD`
    in its module, whose docstring is its page of the simulator's --help.

    Args:
        decoder: of what it receives; None: it reads nothing.
    """

    NAME = ''
    SUMMARY = ''                         # what it is, in a line of --help
    FAULTS = ''                          # what ``--fault all`` is: see faults.py
    READS = True                         # False: it only talks
    MEASURES_PACE = False                # it has to be woken in time: a heartbeat, say
    CHATTER = b''                        # what it babbles at a reset
    DELIMITER: Optional[bytes] = None    # what has to stand before a frame for it to be found

    @classmethod
    def add_options(cls, parser: argparse.ArgumentParser) -> None:
        """Its own options on the simulator's command line."""

    @classmethod
    def from_options(cls, options: argparse.Namespace) -> 'Board':
        """The board that these options describe; `options.seed` is a number, and
        `options.config` are the custom messages, where the board may have some."""
        return cls()

    def __init__(self, decoder: Any = None) -> None:
        self.line: Any = None            # set by the Line
        self.decoder = decoder
        self._timer = FrameTimer(decoder, FRAME_TIMEOUT) if decoder is not None else None
        self._last_byte = 0.0

    # -- what happens to it ---------------------------------------------------------------

    def power_on(self, now: float) -> None:
        """It starts, or restarts: what it knew is gone, things stand where they stood."""

    def power_off(self, now: float) -> None:
        """The moment of a reset."""

    def receive(self, data: bytes, now: float) -> None:
        """Bytes have come."""
        if self.decoder is None:
            return
        self._last_byte = now
        for frame in self.decoder.feed(data, now):
            self.frame(frame, now)

    def tick(self, now: float) -> Optional[float]:
        """Do what is due; return when to be called next at the latest, or None."""
        if self._timer is None:
            return self.advance(now)
        for frame in self._timer.overdue(self._last_byte, now):
            self.frame(frame, now)
        times = [self.advance(now), self._timer.due(self._last_byte, now)]
        return min((due for due in times if due is not None), default=None)

    # -- hooks ----------------------------------------------------------------------------

    def frame(self, frame: Frame, now: float) -> None:
        """A frame has come, good or bad."""

    def advance(self, now: float) -> Optional[float]:
        """Move on to `now`; return when to be called next at the latest, or None."""
        return None

    def fields(self, frame: bytes, message: Any) -> dict:
        """What the journal says of a frame that is sent."""
        raise NotImplementedError

    # -- for subclasses ---------------------------------------------------------------------

    def send(self, frame: bytes, message: Any) -> None:
        """The one way out."""
        self.line.send(frame, self.fields(frame, message))

    def note(self, event: str, **fields: Any) -> None:
        """A line for the journal."""
        self.line.note(event, **fields)

    def say(self, text: str) -> None:
        """A line for a person."""
        self.line.say(text)


class Runner:
    """Drives one board on one port until `stop`: opens it again whenever it vanishes.

    Nothing is polled: it sleeps until bytes come or something is due.

    Args:
        board: switched on when the port opens for the first time.
        port: opened and closed here, nowhere else.
        say: is called with lines for a person.
        realtime: ask for real-time priority, for a board that measures the other end's pace.
        line_arguments: as `Line` has them.
    """

    def __init__(self, board: Board, port: Port, say: Callable[[str], None] = lambda text: None,
                 realtime: bool = False, **line_arguments: Any) -> None:
        self.port = port
        self.line = Line(board, port.write, say=say, **line_arguments)
        self._say = say
        self._realtime = realtime
        self._opener = Opener(port, 'board opening')
        self._stopping = self._opener.ending
        self._trouble = ''         # what was said last: why the port is closed
        self._powered = False

    def stop(self) -> None:
        """Make `run` return at once; from any other thread."""
        self._opener.end()
        self.port.wake()

    def run(self) -> None:
        """Run the board in this thread."""
        if self._realtime:
            set_priority(_REALTIME_PRIORITY)
        self._opener.start()
        while self._opener.open(self._not_open, self._idle):
            self._trouble = ''
            self._say(f'{self.port.url}: open')
            self.line.opened(time.monotonic())
            if not self._powered:     # by its own USB plug, as it were
                self._powered = True
                self.line.start(time.monotonic())
            try:
                self._serve()
            except PortError as error:
                self._not_open(str(error), '; opening it again when it returns')
            self.port.close()
            self.line.closed(time.monotonic())

    def _not_open(self, trouble: str, remedy: str = '') -> None:
        if trouble != self._trouble:
            self._trouble = trouble
            self._say(f'{self.port.url}: {trouble}{remedy}')

    def _idle(self, now: float) -> Optional[float]:
        """The port is closed; a board that is on lives on."""
        return self.line.tick(now) if self._powered else None

    def _serve(self) -> None:
        now = time.monotonic()
        while not self._stopping.is_set():
            due = self.line.tick(now)
            if due is not None:
                due = max(due, now)     # nobody is late for what was due before it was known
            timeout = None if due is None else due - now
            if self.line.stalled(now):
                self._stopping.wait(timeout)
                data = b''
            else:
                data = self.port.read(timeout)
            now = time.monotonic()
            if due is not None and now > due + _LATE:
                self.line.note('late', by=round(now - due, 4))
            if data:
                self.line.receive(data, now)
