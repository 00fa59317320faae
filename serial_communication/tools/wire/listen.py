"""Shows every frame that a board sends. Nothing is ever written to the port.

Each line has the time, the time since the frame before, the bytes, and their meaning or what is
wrong with them. The port is opened as the bridge opens it: exclusively, and so that opening it
again does not reset a board (an Arduino resets once, at the first opening after it was plugged
in). Two readers of a port would take bytes from each other, so while the bridge has the port, this
program reports that and ends. An absent port is waited for. Ctrl-C ends the program.

examples:
  wire listen mcu /dev/ttyUSB0
  wire listen arduino /dev/serial/by-id/usb-1a86_USB2.0-Serial-if00-port0 | tee drive.txt
  wire listen bus socket://192.168.1.7:4001
"""
import argparse
import os
import time
from datetime import datetime
from typing import Optional

from ...framing.stream import Frame, FrameTimer
from ...transport.port import Port, PortError
from . import lines
from .lines import Settings, WireError, note

SUMMARY = 'show every frame that a board sends; writes nothing to the port'

_FRAME_TIMEOUT = 0.05   # s; the default of the bridge's parameter frame_timeout
_AGAIN = 0.5            # s until an absent port is tried again
# s that a read waits, at most: a signal that arrives just before it begins does not end it.
_LONGEST_WAIT = 1.0


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `wire listen`."""
    lines.add_options(parser, with_port=True)


def run(options: argparse.Namespace) -> int:
    """Listen until Ctrl-C, open the port again whenever it vanishes, and return the exit status.

    Raises:
        WireError: the port is there, but cannot be opened.
    """
    line = lines.settings(options)
    port, printer = Port(options.port, line.baud), _Printer()
    trouble: Optional[str] = None
    try:
        while True:
            try:
                port.open()
                note(f'{port.url}: open')
                trouble = ''
                _listen(port, line, printer)
            except PortError as error:
                port.close()
                if trouble is None and os.path.exists(port.url):
                    raise WireError(f'{port.url}: {error}. Frames of a bridge that runs: '
                                    'rostopic echo /serial_msg') from None
                if trouble != str(error):
                    trouble = str(error)
                    note(f'{port.url}: {trouble}')
            time.sleep(_AGAIN)
    except KeyboardInterrupt:
        note(f'{printer.frames} frames, {printer.invalid} of them invalid')
    finally:
        port.close()
    return 0


def _listen(port: Port, line: Settings, printer: '_Printer') -> None:
    """Print frames until the port vanishes; PortError then."""
    decoder = lines.decoder(line, False)
    timer = FrameTimer(decoder, _FRAME_TIMEOUT, line.baud)
    now = last_byte = time.monotonic()
    while True:
        due = timer.due(last_byte)
        data = port.read(min(_LONGEST_WAIT, due - now if due else _LONGEST_WAIT))
        now = time.monotonic()
        last_byte = now if data else last_byte
        frames = decoder.feed(data, now) if data else []
        for frame in frames + timer.overdue(last_byte, now):
            printer.show(frame)


class _Printer:
    """Prints frames, a line for each, and counts them."""

    def __init__(self) -> None:
        self.frames = 0
        self.invalid = 0
        self._epoch = time.time() - time.monotonic()    # s since 1970 when the frames' clock was 0
        self._latest: Optional[float] = None            # the stamp of the frame before

    def show(self, frame: Frame) -> None:
        """Print a frame."""
        gap = '' if self._latest is None else f'+{max(frame.stamp - self._latest, 0) * 1000:.2f} ms'
        self._latest = frame.stamp
        self.frames += 1
        self.invalid += bool(frame.cause)
        at = datetime.fromtimestamp(frame.stamp + self._epoch).strftime('%H:%M:%S.%f')
        print(f'{at}  {gap:>12}  {frame.raw.hex(" "):48}  {frame.trouble or frame.text}'.rstrip(),
              flush=True)
