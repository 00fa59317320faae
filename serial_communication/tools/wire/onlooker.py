"""Shows every frame that one or two ports bring, as it comes, and keeps the bytes if asked to."""
import argparse
import json
import signal
import sys
import time
from datetime import datetime
from typing import List, Optional, Sequence

from ...framing.stream import Frame
from ...transport.port import Port, check_url
from . import lines
from .lines import Direction, Settings
from .live import Backlog, Event, Keeper, Reach, claim, watch
from .recording import Seen
from .show import Paint, complain, frame_line, no_more_output, seconds

_SWITCH_INTERVAL = 0.0005   # s that decoding and printing may keep the interpreter from the line


class End:
    """One end of a line. Of two, each gets what comes from the other."""

    def __init__(self, port: Port, sent: bool) -> None:
        self.port = port
        self.sent = sent      # what comes from it is sent to the board


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of `look_on`."""
    parser.add_argument('--raw', metavar='FILE',
                        help='keep the bytes with their times there, for wire play and wire stats')
    parser.add_argument('--duration', type=lines.positive, metavar='S', help='end after that')
    parser.add_argument('--json', action='store_true',
                        help='a JSON object a line: time (s since 1970), gap (s), from (board or '
                             'computer), type, command, data, frame, text, error')


def port_name(text: str) -> str:
    """For argparse: whatever pyserial may be able to open."""
    try:
        check_url(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f'{text}: {error}') from None
    return text


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

    def event(self, event: Event) -> None:
        """A word about a port; apart from the frames, so that they can be taken by a program."""
        complain(event.text)


def show(seen: Sequence[Seen], began: float, options: argparse.Namespace) -> int:
    """What was kept; times are in seconds since 1970 at `began`. The exit status."""
    printer = Printer(options.json, began, 0.0)
    try:
        for each in seen:
            printer.frame(each.sent, each.frame)
    except BrokenPipeError:
        no_more_output()
    complain(f'{printer.frames} frames, {printer.bad} of them bad')
    return 0


def look_on(line: Settings, ends: Sequence[End], options: argparse.Namespace) -> int:
    """Until Ctrl-C, or the end of --duration; the exit status."""
    for end in ends:
        refused = claim(end.port)
        if refused:
            complain(refused)
            return 1
    sys.setswitchinterval(_SWITCH_INTERVAL)
    began, start = time.time(), time.monotonic()
    backlogs: List[Backlog] = [Backlog()]
    keeper = None
    if options.raw:
        try:
            keeper = Keeper(options.raw, line, began, start)
        except OSError as error:
            complain(f'{options.raw}: {error.strerror}')
            return 1
        keeper.start()
        backlogs.append(keeper.backlog)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)     # as Ctrl-C
    # A tap is part of the line, which must not be cut for a full disk.
    printer = Printer(options.json, began, start, goes_on=len(ends) > 1 or bool(keeper))
    reaches = [Reach(end.port, end.sent, backlogs) for end in ends]
    if len(reaches) > 1:
        for reach, other in (reaches, reaches[::-1]):
            reach.connect(other, line)
    try:
        for reach in reaches:
            reach.start()
        watch(backlogs[0], [Direction(line, end.sent) for end in ends],
              start + options.duration if options.duration else None,
              lambda direction, frame: printer.frame(direction.sent, frame), printer.event)
    except KeyboardInterrupt:
        pass
    except BrokenPipeError:
        no_more_output()
    finally:
        for reach in reaches:
            reach.stop()
        for reach in reaches:
            reach.join()
        if keeper:
            keeper.stop()
    lost = sum(reach.lost for reach in reaches)
    complain(f'{printer.frames} frames, {printer.bad} of them bad, in '
             f'{time.monotonic() - start:.1f} s'
             + (f'; {lost} bytes could not be passed on' if lost else '')
             + (f'; kept in {options.raw}' if keeper and not keeper.trouble else ''))
    return 1 if printer.trouble or keeper and keeper.trouble else 0
