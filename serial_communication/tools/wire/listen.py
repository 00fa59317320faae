"""Shows every frame that a board sends. Nothing is ever written to the port.

Each line has the time, the time since the frame before, the bytes, and their meaning or what is
wrong with them. The port is opened as the bridge opens it: exclusively, and so that opening it
again does not reset a board (an Arduino resets once, at the first opening after it was plugged
in). A port that is absent, or that another program has open, is waited for. Ctrl-C ends the
program.
"""
import argparse
import time
from datetime import datetime
from typing import Iterator, Optional

from ...framing.stream import Frame, FrameTimer
from ...transport.port import Port, PortError
from . import lines
from .lines import Settings, note

SUMMARY = 'show every frame that a board sends; writes nothing to the port'

_FRAME_TIMEOUT = 0.05   # s; the default of the bridge's parameter frame_timeout
_AGAIN = 0.5            # s until an absent port is tried again
# s that a read waits, at most: a signal that arrives just before it begins does not end it.
_LONGEST_WAIT = 1.0


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `wire listen`."""
    lines.add_options(parser, with_port=True)


def run(options: argparse.Namespace) -> int:
    """Listen until Ctrl-C, and return the exit status."""
    line = lines.settings(options)
    epoch = time.time() - time.monotonic()      # s since 1970 when the frames' clock was 0
    before: Optional[float] = None              # the stamp of the frame before
    count = invalid = 0
    try:
        for frame in _frames(Port(options.port, line.baud), line):
            at = datetime.fromtimestamp(frame.stamp + epoch).strftime('%H:%M:%S.%f')
            gap = '' if before is None else f'+{max(frame.stamp - before, 0) * 1000:.2f} ms'
            words = frame.trouble or frame.text
            print(f'{at}  {gap:>12}  {frame.raw.hex(" "):48}  {words}'.rstrip(), flush=True)
            before = frame.stamp
            count += 1
            invalid += bool(frame.cause)
    except KeyboardInterrupt:
        note(f'{count} frames, {invalid} of them invalid')
    return 0


def _frames(port: Port, line: Settings) -> Iterator[Frame]:
    """The frames that arrive; the port is opened again whenever it vanishes."""
    trouble = ''
    while True:
        try:
            port.open()
            note(f'{port.url}: open')
            trouble = ''
            yield from _received(port, line)
        except PortError as error:
            port.close()
            if trouble != str(error):
                trouble = str(error)
                note(f'{port.url}: {trouble}')
        time.sleep(_AGAIN)


def _received(port: Port, line: Settings) -> Iterator[Frame]:
    """The frames until the port vanishes; PortError then."""
    decoder = line.decoder()
    timer = FrameTimer(decoder, _FRAME_TIMEOUT, line.baud)
    now = last_byte = time.monotonic()
    while True:
        due = timer.due(last_byte)
        data = port.read(min(_LONGEST_WAIT, due - now if due else _LONGEST_WAIT))
        now = time.monotonic()
        last_byte = now if data else last_byte
        yield from decoder.feed(data, now) if data else []
        yield from timer.overdue(last_byte, now)
