"""The lines that are known here, and one direction of one, decoded as a link decodes it."""
import argparse
import sys
from typing import Any, Callable, List, Mapping, NamedTuple, NoReturn, Optional

from ...boards import BOARDS, BoardError, find
from ...boards.config_file import of_board, read_parameters
from ...boards.description import Description
from ...framing.frame_timer import FrameTimer
from ...framing.stream import Frame

BAUD = 115200
MAX_BAUD = 10 ** 8
FRAME_TIMEOUT = 0.05     # s; the default of the bridge's parameter frame_timeout
UNKNOWN_TYPE = 'not known here'      # what `explain` says of one
_TYPES = ('type', 'TYPE', 'CMD1', 'CMD2')    # fields that say what a frame is


class Settings(NamedTuple):
    """What has to be known of a line to decode it."""

    board: Description
    baud: int = BAUD
    frame_timeout: float = FRAME_TIMEOUT     # s
    parameters: Mapping[str, Any] = {}       # the board's own, as the bridge has them

    @property
    def link(self) -> str:
        """The name of the link."""
        return self.board.name


def positive(text: str) -> float:
    """For argparse: a number above 0."""
    value = float(text)
    if not 0 < value < float('inf'):
        raise argparse.ArgumentTypeError(f'{text} is not above 0')
    return value


def baud(text: str) -> int:
    """For argparse, and of a recording: a baud rate."""
    value = int(text)
    if not 0 < value <= MAX_BAUD:
        raise argparse.ArgumentTypeError(f'{text} is none of 1 to {MAX_BAUD}')
    return value


def add_link_options(parser: argparse.ArgumentParser) -> None:
    """LINK, and what changes how its bytes are read."""
    parser.add_argument('link', metavar='LINK',
                        help='whose protocol it is: ' + ', '.join(BOARDS) + ', a link that the '
                             'boards of --config have, or a package with a board')
    for board in map(find, BOARDS):
        for flag, meaning in board.wire_flags.items():
            parser.add_argument('--' + flag.replace('_', '-'), action='append_const',
                                dest='flags', const=flag, default=[],
                                help=f'{board.name}: {meaning}')
    add_config_option(parser)
    parser.set_defaults(baud=BAUD, frame_timeout=FRAME_TIMEOUT)


def add_config_option(parser: argparse.ArgumentParser) -> None:
    """What `known_lines` reads."""
    parser.add_argument('--config', default='', metavar='FILE',
                        help='parameters of the bridge: its custom messages and functions, and '
                             'its boards of other packages, are known, too')


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options that `settings` reads, LINK among them."""
    add_link_options(parser)
    parser.add_argument('--baud', type=baud, default=BAUD, metavar='N', help='(%(default)d)')
    parser.add_argument('--frame-timeout', type=positive, default=FRAME_TIMEOUT, metavar='S',
                        help='an incomplete frame is given up after so long without a byte, as '
                             "by the bridge's parameter of that name (%(default)g)")


def settings(options: argparse.Namespace) -> Settings:
    """From the command line; what cannot be used ends the program."""
    line = known_lines(options.config)(options.link, options.baud)
    flags = {flag: True for flag in options.flags if flag in line.board.wire_flags}
    return line._replace(frame_timeout=options.frame_timeout,
                         parameters={**line.parameters, **flags})


def known_lines(config: str) -> Callable[[str, int], Settings]:
    """What makes the settings of a link, by its name and baud rate, with a file of the bridge's
    parameters or, for '', without; what cannot be used ends the program."""
    try:
        parameters = read_parameters(config) if config else {}
    except (OSError, ValueError) as error:
        _fail(f'{config}: {error}')
    packages = parameters.get('boards')

    def known(link: str, baud_rate: int = BAUD) -> Settings:
        try:
            board = find(link, packages if isinstance(packages, list) else ())
        except BoardError as error:
            _fail(f'there is no board {link}, only {", ".join(BOARDS)}; one of another package is '
                  f'known by --config with its `boards`, or by the name of the package: {error}')
        line = Settings(board, baud_rate, parameters=of_board(parameters, board.name))
        try:
            decoder(line, False)
        except ValueError as error:      # of a custom message
            _fail(f'{config}: {error}')
        return line

    return known


def _fail(text: str) -> NoReturn:
    print(f'wire: {text}', file=sys.stderr)
    raise SystemExit(2)


def decoder(line: Settings, sent: bool) -> Any:
    """A decoder of what the board sends, or of what is `sent` to it."""
    return line.board.decoder(sent, line.parameters)


def type_name(line: Settings, sent: bool, frame: Frame) -> str:
    """What a good frame is, in the protocol's words."""
    parts = decoder(line, sent).explain(frame.raw)
    words = [part.meaning for part in parts if part.name in _TYPES and part.meaning
             and part.meaning != UNKNOWN_TYPE]
    if not words:
        return f'type 0x{frame.type:02x}'
    return words[-1] if words != ['function'] else f'function 0x{frame.command:02x}'


class Direction:
    """What one end of a line says, decoded; live, or later from what was kept.

    Incomplete frames are given up after the same times as in a link, by the times of the reads.
    All times are seconds of one clock. A frame's stamp is the time of the read that brought its
    last byte.
    """

    def __init__(self, line: Settings, sent: bool) -> None:
        self.sent = sent
        self.decoder = decoder(line, sent)
        self._timer = FrameTimer(self.decoder, line.frame_timeout, line.baud)
        self._last_byte = float('-inf')
        self._now = 0.0

    def hear(self, data: bytes, at: float) -> List[Frame]:
        """The frames that are complete, or given up, by the time of this read."""
        frames = []
        while True:
            due = self.due()
            if due is None or due >= at:     # a link looks at its bytes first
                break
            frames += self._give_up(due)
        self._last_byte = self._now = at
        return frames + self.decoder.feed(data, at) + self._give_up(at)

    def silent_until(self, now: float) -> List[Frame]:
        """The frames that are given up by `now`, if nothing has come."""
        frames: List[Frame] = []
        while True:
            due = self.due()
            if due is None or due > now:
                return frames
            frames += self._give_up(due)

    def due(self) -> Optional[float]:
        """When to call `silent_until` next; None: not before something is heard."""
        return self._timer.due(self._last_byte, self._now)

    def reset(self) -> None:
        """Forget what is pending: the port was closed, or bytes are missing."""
        self.decoder.reset()
        self._timer.reset()

    def _give_up(self, now: float) -> List[Frame]:
        self._now = now
        return self._timer.overdue(self._last_byte, now)
