"""The base of simulated boards, and the runner that drives one on a port."""
import argparse
import threading
import time
from typing import Callable, Optional

from ..framing.stream import Decoder, Frame, FrameTimer
from ..transport.pace import set_priority
from ..transport.port import Port, PortError
from .faults import Faults
from .line import SimulatedLine

FRAME_TIMEOUT = 0.05     # s without a byte after which an incomplete frame is given up
_REALTIME_PRIORITY = 10  # lower than that of the bridge's heartbeat


def positive(text: str) -> float:
    """The positive, finite number of a command line option.

    Raises:
        argparse.ArgumentTypeError: it is out of range.
    """
    value = float(text)
    if not 0 < value < float('inf'):
        raise argparse.ArgumentTypeError(f'{text} is out of range (above 0)')
    return value


class Board:
    """Base of the boards: a state machine. It has no I/O and no clock: times are passed in.

    A subclass overrides the hooks and the attributes below. Its module has it as `BOARD`; the
    module's docstring is the board's page in the simulator's --help.

    Args:
        decoder: for the bytes that it receives; None: it reads nothing.
    """

    NAME = ''
    SUMMARY = ''                         # one line for --help
    FAULTS = ''                          # the faults of ``--faults all``: see faults.py
    READS = True                         # False: it only sends
    HAS_CLOCK = False                    # True: it can send its time
    MEASURES_PACE = False                # True: it needs to be woken in time, as for heartbeats
    CHATTER = b''                        # bytes that it sends at a reset
    line: SimulatedLine                  # which sets it

    @classmethod
    def add_options(cls, parser: argparse.ArgumentParser) -> None:
        """Add this board's options to the simulator's command line."""

    @classmethod
    def from_options(cls, options: argparse.Namespace) -> 'Board':
        """Make the board that these options describe.

        `options.seed` is always a number. `options.config` has the custom messages, if the board's
        description allows some, and `options.announcement` the text to announce, or None.
        """
        return cls()

    def __init__(self, decoder: Optional[Decoder] = None) -> None:
        self.decoder = decoder
        self._timer = FrameTimer(decoder, FRAME_TIMEOUT) if decoder is not None else None
        self._last_byte = 0.0

    # -- called by the line ---------------------------------------------------------------

    def power_on(self, now: float) -> None:
        """Start, or restart: the memory is lost, mechanical parts keep their positions."""

    def power_off(self, now: float) -> None:
        """A reset begins."""

    def receive(self, data: bytes, now: float) -> None:
        """Decode received bytes."""
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
        times = [self.advance(now), self._timer.due(self._last_byte)]
        return min((due for due in times if due is not None), default=None)

    # -- hooks, which use the line: send, note, say -----------------------------------------

    def frame(self, frame: Frame, now: float) -> None:
        """A frame was received, valid or invalid."""

    def advance(self, now: float) -> Optional[float]:
        """Advance the state to `now`; return when to be called next at the latest, or None."""
        return None


class Runner:
    """Drives one board on one port until `stop`; opens the port again whenever it vanishes.

    It sleeps until bytes are received or something is due.

    Args:
        board: switched on when the port is opened for the first time.
        port: the runner alone opens and closes it.
        say: called with lines for people.
        faults: None: no faults.
    """

    def __init__(self, board: Board, port: Port, say: Callable[[str], None] = lambda text: None,
                 faults: Optional[Faults] = None) -> None:
        self.port = port
        self.line = SimulatedLine(board, port.write, faults, say=say)
        self._say = say
        self._stopping = threading.Event()
        self._trouble = ''         # why the port is closed, as it was printed last
        self._powered = False

    def stop(self) -> None:
        """Make `run` return soon; from another thread, or a signal's handler."""
        self._stopping.set()
        self.port.wake()

    def run(self) -> None:
        """Run the board in this thread."""
        if self.line.board.MEASURES_PACE:
            set_priority(_REALTIME_PRIORITY)
        while not self._stopping.is_set():
            try:
                self.port.open()
                self._trouble = ''
                self._say(f'{self.port.url}: open')
                if not self._powered:     # the first opening is as if its USB plug were put in
                    self._powered = True
                    self.line.start(time.monotonic())
                self._serve()
            except PortError as error:
                if self._trouble != str(error):
                    self._trouble = str(error)
                    self._say(f'{self.port.url}: {error}')
            self.port.close()
            self.line.closed()
            self._pause()

    def _pause(self) -> None:
        """Run the board until the port is tried again."""
        end = time.monotonic() + self.port.RETRY
        while time.monotonic() < end and not self._stopping.is_set():
            due = self.line.tick(time.monotonic()) if self._powered else None
            self.port.pause(min(end, end if due is None else due) - time.monotonic())

    def _serve(self) -> None:
        while not self._stopping.is_set():
            now = time.monotonic()
            due = self.line.tick(now)
            timeout = None if due is None else max(due - now, 0.0)
            if self.line.stalled(now):
                self._stopping.wait(timeout)
                continue
            data = self.port.read(timeout)
            if data:
                self.line.receive(data, time.monotonic())
