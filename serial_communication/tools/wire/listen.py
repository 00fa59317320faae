"""Shows every frame that a board sends. Nothing is ever written to the port.

Each line has the time, the time since the frame before, the bytes, and their meaning or what is
wrong with them. The port is opened as the bridge opens it: exclusively, and so that opening it
again does not reset a board (an Arduino resets once, at the first opening after it was plugged
in). Two readers of a port would take bytes from each other, so while the bridge has the port, this
program reports that and ends. An absent port is waited for. Ctrl-C ends the program.

While its output is held (Ctrl-S, a pager) the kernel keeps 4 KB. What comes after that is lost.

examples:
  wire listen mcu /dev/ttyUSB0
  wire listen arduino /dev/serial/by-id/usb-1a86_USB2.0-Serial-if00-port0 | tee drive.txt
  wire listen bus socket://192.168.1.7:4001
"""
import argparse
import os
import time
from datetime import datetime
from typing import Any, Optional

from ...framing.rows import Kind
from ...framing.stream import Frame, FrameTimer
from ...transport.port import Port, PortError
from . import lines
from .announced import Learner
from .show import Paint, WireError, hexed, print_note, seconds

SUMMARY = 'show every frame that a board sends; writes nothing to the port'

_FRAME_TIMEOUT = 0.05   # s; the default of the bridge's parameter frame_timeout
_AGAIN = 0.5            # s until an absent port is tried again
# s that a read waits, at most: a signal that arrives just before it begins does not end it.
_LONGEST_WAIT = 1.0


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `wire listen`."""
    lines.add_options(parser)
    lines.add_port(parser)


def run(options: argparse.Namespace) -> int:
    """Listen until Ctrl-C, and return the exit status."""
    line = lines.settings(options)
    port = Port(options.port, line.baud)
    listener = _Listener(line, port)
    try:
        listener.run()
    except KeyboardInterrupt:
        print_note(f'{listener.frames} frames, {listener.invalid} of them invalid')
    finally:
        port.close()
    return 0


class _Listener:
    """Prints a line for each frame that is received on a port."""

    def __init__(self, line: lines.Settings, port: Port) -> None:
        self.frames = 0
        self.invalid = 0
        self._port = port
        self._learner = Learner(line)
        self._paint = Paint()
        self._epoch = time.time() - time.monotonic()    # s since 1970 when the frames' clock was 0
        self._latest: Optional[float] = None            # the stamp of the frame before

    def run(self) -> None:
        """Print frames for ever; open the port again whenever it vanishes.

        Raises:
            WireError: the port is there, but cannot be opened.
        """
        trouble = None
        while True:
            try:
                self._port.open()
                print_note(f'{self._port.url}: open')
                trouble = ''
                self._listen()
            except PortError as error:
                self._port.close()
                if trouble is None and os.path.exists(self._port.url):
                    raise WireError(f'{self._port.url}: {error}. Frames of a bridge that runs: '
                                    'rostopic echo /serial_msg') from None
                if trouble != str(error):
                    trouble = str(error)
                    print_note(f'{self._port.url}: {trouble}')
            time.sleep(_AGAIN)

    def _listen(self) -> None:
        line = self._learner.line
        decoder: Any = lines.decoder(line, False)
        timer = FrameTimer(decoder, _FRAME_TIMEOUT, line.baud)
        now = last_byte = time.monotonic()
        while True:
            due = timer.due(last_byte)
            data = self._port.read(min(_LONGEST_WAIT, due - now if due else _LONGEST_WAIT))
            now = time.monotonic()
            frames = []
            if data:
                last_byte = now
                frames = decoder.feed(data, now)
            for frame in frames + timer.overdue(last_byte, now):
                self._print(frame)
                self._learn(decoder, frame)

    def _print(self, frame: Frame) -> None:
        gap = '' if self._latest is None else '+' + seconds(max(frame.stamp - self._latest, 0.0))
        self._latest = frame.stamp
        self.frames += 1
        self.invalid += bool(frame.cause)
        at = datetime.fromtimestamp(frame.stamp + self._epoch).strftime('%H:%M:%S.%f')
        words = self._paint(frame.trouble, 'bad') if frame.cause else frame.text
        print(f'{at}  {gap:>12}  {hexed(frame.raw):48}  {words}'.rstrip(), flush=True)

    def _learn(self, decoder: Any, frame: Frame) -> None:
        """Make the decoder know what the board announces."""
        for row in self._learner.take(False, frame):
            if row.kind in (Kind.FROM, Kind.SETTING):
                decoder.add_message(row.message)
