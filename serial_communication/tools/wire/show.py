"""Lines for people: bytes, times and words of a frame; colours on a terminal only."""
import os
import sys
from typing import Any

from ...framing.stream import Frame

_MOST_BYTES = 32       # of a frame on a line
_COLOURS = {'board': '36', 'computer': '33', 'bad': '31', 'good': '32', 'dim': '2'}


class Trouble(Exception):
    """Ends the program; the text is one line for a person."""

    status = 1     # of the program


def is_terminal(stream: Any = None) -> bool:
    """Whether somebody looks at it who sees colours, and a line that is rewritten."""
    stream = sys.stdout if stream is None else stream
    return stream.isatty() and os.environ.get('TERM', 'dumb') != 'dumb'


class Paint:
    """Colours, or none."""

    def __init__(self, stream: Any = None) -> None:
        self._on = is_terminal(stream) and 'NO_COLOR' not in os.environ

    def __call__(self, text: str, colour: str) -> str:
        """`text` in that colour: board, computer, bad, good or dim."""
        return f'\033[{_COLOURS[colour]}m{text}\033[0m' if self._on and text else text


def hexed(data: bytes, most: int = 0) -> str:
    """Bytes as people write them, `02 0c 10`; of more than `most` the first, and how many."""
    if most and len(data) > most:
        return f'{data[:most].hex(" ")} … {len(data)} bytes'
    return data.hex(' ')


def frame_line(frame: Frame, speaker: str, gap: str, clock: str, paint: Paint) -> str:
    """One frame: when, how long after the one before, who, bytes, words."""
    words = paint(frame.trouble, 'bad') if frame.cause else frame.text
    return (f'{clock}  {gap:>12}  {paint(f"{speaker:8}", speaker)}  '
            f'{hexed(frame.raw, _MOST_BYTES):48}  {words}').rstrip()


def seconds(value: float) -> str:
    """A time in its own unit: 850 us, 10.02 ms, 1.25 s."""
    if value < 0.001:
        return f'{value * 1e6:.0f} us'
    return f'{value * 1e3:.2f} ms' if value < 1 else f'{value:.3f} s'


def no_more_output(descriptor: int = 1) -> None:
    """It cannot be written to: leave nothing that the interpreter would fail to flush."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)


def complain(text: str) -> None:
    """One line on standard error; where that cannot be written to, nobody is left to be told."""
    try:
        print(text, file=sys.stderr, flush=True)
    except OSError:
        no_more_output(2)
