"""Settings of a serial line, and a decoder for one direction that works like a link's."""
import argparse
from typing import Any, Callable, List, Mapping, NamedTuple, Optional

from ...boards import BOARDS, BoardError, descriptions, find
from ...boards.config_file import board_packages, board_parameters, read_parameters
from ...boards.description import Description
from ...framing.frame_timer import FrameTimer
from ...framing.stream import Decoder, Frame
from .show import WireError

MAX_BAUD = 10 ** 8
FRAME_TIMEOUT = 0.05     # s; the default of the bridge's parameter frame_timeout


class UsageError(WireError):
    """An argument of the command line cannot be used."""

    status = 2


class UnknownBoard(UsageError):
    """No known board has a link of that name."""


class Settings(NamedTuple):
    """What is needed to decode a line."""

    board: Description
    baud: int
    frame_timeout: float = FRAME_TIMEOUT     # s
    parameters: Mapping[str, Any] = {}       # the board's, as the bridge has them

    @property
    def link(self) -> str:
        """The name of the link."""
        return self.board.name


def positive(text: str) -> float:
    """For argparse: a finite number above 0."""
    value = float(text)
    if not 0 < value < float('inf'):
        raise argparse.ArgumentTypeError(f'{text} is not a finite number above 0')
    return value


def baud(text: str) -> int:
    """For argparse: a baud rate, 1 … MAX_BAUD."""
    value = int(text)
    if not 0 < value <= MAX_BAUD:
        raise argparse.ArgumentTypeError(f'{text} baud is out of range (1 … {MAX_BAUD})')
    return value


def add_link_options(parser: argparse.ArgumentParser) -> None:
    """Add LINK, and the options that change how its bytes are decoded."""
    parser.add_argument('link', metavar='LINK',
                        help='the protocol: ' + ', '.join(BOARDS) + ', a link of a board in '
                             '--config, or a package with a board')
    for board in descriptions():
        for flag, meaning in board.wire_flags.items():
            parser.add_argument('--' + flag.replace('_', '-'), action='append_const',
                                dest='flags', const=flag, default=[],
                                help=f'{board.name}: {meaning}')
    add_config_option(parser)
    parser.set_defaults(baud=0, frame_timeout=FRAME_TIMEOUT)


def add_config_option(parser: argparse.ArgumentParser) -> None:
    """Add the option for the file that `known_lines` reads."""
    parser.add_argument('--config', default='', metavar='FILE',
                        help="the bridge's parameters, for its baud rates, its custom messages and "
                             'functions, and its boards of other packages')


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that `settings` reads, including LINK."""
    add_link_options(parser)
    parser.add_argument('--baud', type=baud, default=0, metavar='N',
                        help="(that of --config, or the board's default)")
    parser.add_argument('--frame-timeout', type=positive, default=FRAME_TIMEOUT, metavar='S',
                        help='an incomplete frame is dropped after this time without a byte, as '
                             "by the bridge's parameter of that name (%(default)g)")


def settings(options: argparse.Namespace) -> Settings:
    """Return the settings from the command line.

    Raises:
        UsageError: the link is unknown, or --config cannot be used.
    """
    line = known_lines(options.config)(options.link, options.baud)
    flags = {flag: True for flag in options.flags if flag in line.board.wire_flags}
    return line._replace(frame_timeout=options.frame_timeout,
                         parameters={**line.parameters, **flags})


def known_lines(config: str) -> Callable[[str, int], Settings]:
    """Return a function of a link's name and baud rate that returns its settings.

    Args:
        config: a file with the bridge's parameters, or ''. A rate of 0 is that of its parameters.

    Raises:
        UsageError: the file cannot be used. The returned function raises it for a mistake in a
            board's parameters, and `UnknownBoard` for an unknown name.
    """
    try:
        parameters = read_parameters(config) if config else {}
    except (OSError, ValueError) as error:
        raise UsageError(f'{config}: {error}') from None

    def known(link: str, baud_rate: int = 0) -> Settings:
        try:
            board = find(link, board_packages(parameters))
        except BoardError as error:
            raise UnknownBoard(
                f'there is no board {link}, only {", ".join(BOARDS)}; for a board of another '
                'package give its package, or --config with the parameter `boards`: '
                f'{error}') from None
        own = board_parameters(parameters, board.name)
        try:
            line = Settings(board, baud_rate or board.baud_of(own), parameters=own)
            decoder(line, False)
        except ValueError as error:      # a mistake in the rate or in a custom message
            raise UsageError(f'{config}: {error}') from None
        return line

    return known


def decoder(line: Settings, sent: bool) -> Decoder:
    """Return a decoder of what the board sends, or of what is `sent` to it."""
    return line.board.decoder(sent, line.parameters)


def type_name(line: Settings, sent: bool, frame: Frame) -> str:
    """Return the name of a valid frame's type, as the protocol calls it."""
    name = ''
    for part in decoder(line, sent).explain(frame.raw):
        if part.kind is not None:
            name = part.kind or f'{name or "type"} 0x{part.raw:02x}'
    return name or f'type 0x{frame.type:02x}'


class Direction:
    """Decodes one direction of a line, live or from a recording.

    Incomplete frames are dropped after the same times as in a link. All times are in seconds of one
    clock. A frame's stamp is the time of the read that had its last byte.
    """

    def __init__(self, line: Settings, sent: bool) -> None:
        self.sent = sent
        self.decoder = decoder(line, sent)
        self._timer = FrameTimer(self.decoder, line.frame_timeout, line.baud)
        self._last_byte = float('-inf')

    def feed(self, data: bytes, at: float) -> List[Frame]:
        """Decode a read. Return the frames that are complete, or dropped as incomplete, by now."""
        frames = []
        while True:
            due = self.due()
            if due is None or due >= at:     # a link decodes new bytes before it drops a frame
                break
            frames += self._give_up(due)
        self._last_byte = at
        return frames + self.decoder.feed(data, at) + self._give_up(at)

    def expire(self, now: float) -> List[Frame]:
        """Return the incomplete frames that are dropped by `now` if nothing was received."""
        frames: List[Frame] = []
        while True:
            due = self.due()
            if due is None or due > now:
                return frames
            frames += self._give_up(due)

    def due(self) -> Optional[float]:
        """Return when to call `expire` next; None: not before the next read."""
        return self._timer.due(self._last_byte)

    def reset(self) -> None:
        """Drop pending bytes: the port was closed, or bytes are missing."""
        self.decoder.reset()
        self._timer.reset()

    def _give_up(self, now: float) -> List[Frame]:
        return self._timer.overdue(self._last_byte, now)
