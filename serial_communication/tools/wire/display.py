"""Prints the frames of one or two ports, or of a recording, and records the bytes of ports."""
import argparse
import json
import sys
import time
from datetime import datetime
from typing import Iterable, List, Optional, Sequence

from ...framing.stream import Frame
from ...output import no_more_output
from ...transport.port import Port
from . import lines
from .lines import Settings
from .live import Inbox, PortReader, Recorder, claim, decode_inbox
from .recording import RecordedFrame
from .show import Paint, frame_line, print_note, seconds

_SWITCH_INTERVAL = 0.0005   # s that decoding and printing may delay the threads of the ports


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `show_live`."""
    parser.add_argument('--raw', metavar='FILE',
                        help='record the bytes and their times, for wire play and wire stats')
    parser.add_argument('--duration', type=lines.positive, metavar='S', help='end after S seconds')
    parser.add_argument('--json', action='store_true',
                        help='print JSON objects: time (s since 1970), gap (s), from (board or '
                             'computer), type, command, data, frame, text, error')


class Printer:
    """Prints one line for each frame.

    Args:
        began: seconds since 1970 at the time `start` of the frames' clock.
        start: see `began`.
        goes_on: if a line cannot be written (a full disk), report that and print no more, instead
            of raising OSError.
    """

    def __init__(self, as_json: bool, began: float, start: float, goes_on: bool = False) -> None:
        self.trouble = ''       # why printing has ended
        self._goes_on = goes_on
        self.frames = 0
        self.invalid = 0
        self._as_json = as_json
        self._offset = began - start
        self._last: Optional[float] = None
        self._paint = Paint()

    def frame(self, sent: bool, frame: Frame) -> None:
        """Print a frame, valid or invalid, that was `sent` to the board or by it."""
        sender = 'computer' if sent else 'board'
        gap = None if self._last is None else max(frame.stamp - self._last, 0.0)
        self._last = frame.stamp
        self.frames += 1
        self.invalid += bool(frame.cause)
        at = frame.stamp + self._offset
        if self._as_json:
            self._print(json.dumps({
                'time': round(at, 6), 'gap': None if gap is None else round(gap, 6),
                'from': sender, 'type': frame.type, 'command': frame.number,
                'data': frame.data.hex(), 'frame': frame.raw.hex(), 'text': frame.text,
                'error': frame.trouble}))
        else:
            self._print(frame_line(
                frame, sender, '' if gap is None else '+' + seconds(gap),
                datetime.fromtimestamp(at).strftime('%H:%M:%S.%f'), self._paint))

    def _print(self, text: str) -> None:
        if self.trouble:
            return
        try:
            print(text, flush=True)
        except OSError as error:
            if not self._goes_on or isinstance(error, BrokenPipeError):
                raise
            no_more_output()
            self.trouble = (f'the output cannot be written: {error.strerror}; nothing more is '
                            'printed')
            print_note(self.trouble)

    def summary(self) -> str:
        """Return the number of frames, and of invalid ones."""
        return f'{self.frames} frames, {self.invalid} of them invalid'


def show_recorded(seen: Iterable[RecordedFrame], began: float, options: argparse.Namespace) -> int:
    """Print the frames of a recording that began at `began` s since 1970; return the status."""
    printer = Printer(options.json, began, 0.0)
    try:
        for each in sorted(seen, key=lambda each: each.frame.stamp):
            printer.frame(each.sent, each.frame)
    except BrokenPipeError:
        no_more_output()
    print_note(printer.summary())
    return 0


def show_live(line: Settings, urls: Sequence[str], options: argparse.Namespace) -> int:
    """Print the frames of ports until Ctrl-C or the end of --duration; return the exit status.

    Args:
        urls: the board's port; for a tap also the computer's, with bytes forwarded both ways.
    """
    ports = [Port(url, line.baud) for url in urls]
    for port in ports:
        claim(port)
    sys.setswitchinterval(_SWITCH_INTERVAL)
    began, start = time.time(), time.monotonic()
    inboxes: List[Inbox] = [Inbox()]
    recorder = None
    if options.raw:
        recorder = Recorder(options.raw, line, began, start)
        inboxes.append(recorder.inbox)
    # A tap is part of the line, which a full disk must not interrupt.
    printer = Printer(options.json, began, start, goes_on=len(ports) > 1 or bool(recorder))
    readers = [PortReader(port, sent, inboxes) for port, sent in zip(ports, (False, True))]
    if len(readers) > 1:
        for reader, other in (readers, readers[::-1]):
            reader.connect(other, line)
    try:
        for reader in readers:
            reader.start()
        # Events go to standard error, so that other programs can read the frames.
        decode_inbox(inboxes[0], line, start + options.duration if options.duration else None,
                     printer.frame, lambda event: print_note(event.text))
    except KeyboardInterrupt:
        pass
    except BrokenPipeError:
        no_more_output()
    finally:
        for reader in readers:
            reader.stop()
        for reader in readers:
            reader.join()
        if recorder:
            recorder.stop()
    lost = sum(reader.lost for reader in readers)
    print_note(f'{printer.summary()}, in {time.monotonic() - start:.1f} s'
               + (f'; {lost} bytes could not be forwarded' if lost else '')
               + (f'; recorded in {options.raw}' if recorder and not recorder.trouble else ''))
    return 1 if printer.trouble or recorder and recorder.trouble else 0
