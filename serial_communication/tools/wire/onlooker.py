"""Shows every frame that one or two ports bring, as it comes, and keeps the bytes if asked to."""
import argparse
import json
import sys
import time
from datetime import datetime
from typing import Iterable, List, Optional, Sequence

from ...framing.stream import Frame
from ...transport.port import Port
from . import lines
from .lines import Settings
from .live import Inbox, PortReader, Recorder, claim, watch
from .recording import Seen
from .show import Paint, complain, frame_line, no_more_output, seconds

_SWITCH_INTERVAL = 0.0005   # s that decoding and printing may keep the interpreter from the line


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of `look_on`."""
    parser.add_argument('--raw', metavar='FILE',
                        help='keep the bytes with their times there, for wire play and wire stats')
    parser.add_argument('--duration', type=lines.positive, metavar='S', help='end after that')
    parser.add_argument('--json', action='store_true',
                        help='a JSON object a line: time (s since 1970), gap (s), from (board or '
                             'computer), type, command, data, frame, text, error')


class Printer:
    """A line a frame.

    Args:
        began: seconds since 1970 at the time `start` of the frames' clock.
        goes_on: where a line cannot be written (a full disk), say so and print no more, instead
            of raising OSError.
    """

    def __init__(self, as_json: bool, began: float, start: float, goes_on: bool = False) -> None:
        self.trouble = ''       # why nothing more is printed
        self._goes_on = goes_on
        self.frames = 0
        self.bad = 0
        self._as_json = as_json
        self._offset = began - start
        self._last: Optional[float] = None
        self._paint = Paint()

    def frame(self, sent: bool, frame: Frame) -> None:
        """One frame, good or bad, `sent` to the board or by it."""
        speaker = 'computer' if sent else 'board'
        gap = None if self._last is None else max(frame.stamp - self._last, 0.0)
        self._last = frame.stamp
        self.frames += 1
        self.bad += bool(frame.cause)
        at = frame.stamp + self._offset
        if self._as_json:
            self._print(json.dumps({
                'time': round(at, 6), 'gap': None if gap is None else round(gap, 6),
                'from': speaker, 'type': frame.type, 'command': frame.command,
                'data': frame.data.hex(), 'frame': frame.raw.hex(), 'text': frame.text,
                'error': frame.trouble}))
        else:
            self._print(frame_line(
                frame, speaker, '' if gap is None else '+' + seconds(gap),
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
            complain(self.trouble)

    def summary(self) -> str:
        """How much there was."""
        return f'{self.frames} frames, {self.bad} of them bad'


def show(seen: Iterable[Seen], began: float, options: argparse.Namespace) -> int:
    """What was kept; times are in seconds since 1970 at `began`. The exit status."""
    printer = Printer(options.json, began, 0.0)
    try:
        for each in sorted(seen, key=lambda each: each.frame.stamp):
            printer.frame(each.sent, each.frame)
    except BrokenPipeError:
        no_more_output()
    complain(printer.summary())
    return 0


def look_on(line: Settings, urls: Sequence[str], options: argparse.Namespace) -> int:
    """At the board's port, or at the board's and the computer's, each of which gets what comes
    from the other; until Ctrl-C, or the end of --duration. The exit status."""
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
    # A tap is part of the line, which must not be cut for a full disk.
    printer = Printer(options.json, began, start, goes_on=len(ports) > 1 or bool(recorder))
    readers = [PortReader(port, sent, inboxes) for port, sent in zip(ports, (False, True))]
    if len(readers) > 1:
        for reader, other in (readers, readers[::-1]):
            reader.connect(other, line)
    try:
        for reader in readers:
            reader.start()
        # Events are kept apart from the frames, so that a program can take those.
        watch(inboxes[0], line, start + options.duration if options.duration else None,
              printer.frame, lambda event: complain(event.text))
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
    complain(f'{printer.summary()}, in {time.monotonic() - start:.1f} s'
             + (f'; {lost} bytes could not be passed on' if lost else '')
             + (f'; kept in {options.raw}' if recorder and not recorder.trouble else ''))
    return 1 if printer.trouble or recorder and recorder.trouble else 0
