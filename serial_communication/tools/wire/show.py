"""Formatting for users: bytes and times, with colours on a terminal."""
import os
import sys

from ...output import no_more_output

_COLOURS = {'board': '36', 'computer': '33', 'bad': '31', 'dim': '2'}


class WireError(Exception):
    """Ends the program; its text is one line for the user."""

    status = 1     # exit status of the program


class Paint:
    """Colours text, if standard output is a terminal with colours and NO_COLOR is not set."""

    def __init__(self) -> None:
        self._on = sys.stdout.isatty() and os.environ.get('TERM', 'dumb') != 'dumb' \
            and not os.environ.get('NO_COLOR')

    def __call__(self, text: str, colour: str) -> str:
        """Return `text` in a colour: board, computer, bad or dim."""
        return f'\033[{_COLOURS[colour]}m{text}\033[0m' if self._on and text else text


def hexed(data: bytes) -> str:
    """Return bytes as `02 0c 10`."""
    return data.hex(' ')


def seconds(value: float) -> str:
    """Return a time, given in seconds, in a suitable unit: 850 us, 10.02 ms, 1.250 s."""
    if value < 0.001:
        return f'{value * 1e6:.0f} us'
    return f'{value * 1e3:.2f} ms' if value < 1 else f'{value:.3f} s'


def print_note(text: str) -> None:
    """Print a line on standard error; nothing where that cannot be written to."""
    try:
        print(text, file=sys.stderr, flush=True)
    except OSError:
        no_more_output(2)
