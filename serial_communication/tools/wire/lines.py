"""The lines that are known here, and one direction of one, decoded as a link decodes it."""
import argparse
from typing import Any, Callable, List, Mapping, NamedTuple, Optional

from ...boards import BOARDS, BoardError, find
from ...boards.config_file import of_board, read_parameters
from ...boards.description import Description
from ...framing.frame_timer import FrameTimer
from ...framing.stream import Frame
from ...transport.port import check_url
from .show import Trouble

MAX_BAUD = 10 ** 8
FRAME_TIMEOUT = 0.05     # s; the default of the bridge's parameter frame_timeout


class Unusable(Trouble):
    """What the command line says cannot be used."""

    status = 2


class UnknownBoard(Unusable):
    """No board has a link of that name."""


class Settings(NamedTuple):
    """What has to be known of a line to decode it."""

    board: Description
    baud: int
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


def port(text: str) -> str:
    """For argparse: whatever pyserial may be able to open."""
    try:
        check_url(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f'{text}: {error}') from None
    return text


def baud(text: str) -> int:
    """For argparse: a baud rate."""
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
    parser.set_defaults(baud=0, frame_timeout=FRAME_TIMEOUT)


def add_config_option(parser: argparse.ArgumentParser) -> None:
    """What `known_lines` reads."""
    parser.add_argument('--config', default='', metavar='FILE',
                        help='parameters of the bridge: its custom messages and functions, and '
                             'its boards of other packages, are known, too')


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options that `settings` reads, LINK among them."""
    add_link_options(parser)
    parser.add_argument('--baud', type=baud, default=0, metavar='N', help="(the board's own)")
    parser.add_argument('--frame-timeout', type=positive, default=FRAME_TIMEOUT, metavar='S',
                        help='an incomplete frame is given up after so long without a byte, as '
                             "by the bridge's parameter of that name (%(default)g)")


def settings(options: argparse.Namespace) -> Settings:
    """From the command line; `Unusable` where it is."""
    line = known_lines(options.config)(options.link, options.baud)
    flags = {flag: True for flag in options.flags if flag in line.board.wire_flags}
    return line._replace(frame_timeout=options.frame_timeout,
                         parameters={**line.parameters, **flags})


def known_lines(config: str) -> Callable[[str, int], Settings]:
    """What makes the settings of a link, by its name and baud rate, with a file of the bridge's
    parameters or, for '', without.

    Both raise `Unusable`, the one that is returned for a name also `UnknownBoard`.
    """
    try:
        parameters = read_parameters(config) if config else {}
    except (OSError, ValueError) as error:
        raise Unusable(f'{config}: {error}') from None
    packages = parameters.get('boards')

    def known(link: str, baud_rate: int = 0) -> Settings:
        try:
            board = find(link, packages if isinstance(packages, list) else ())
        except BoardError as error:
            raise UnknownBoard(
                f'there is no board {link}, only {", ".join(BOARDS)}; one of another package is '
                'known by --config with its `boards`, or by the name of its package: '
                f'{error}') from None
        line = Settings(board, baud_rate or board.baud,
                        parameters=of_board(parameters, board.name))
        try:
            decoder(line, False)
        except ValueError as error:      # of a custom message
            raise Unusable(f'{config}: {error}') from None
        return line

    return known


def decoder(line: Settings, sent: bool) -> Any:
    """A decoder of what the board sends, or of what is `sent` to it."""
    return line.board.decoder(sent, line.parameters)


def type_name(line: Settings, sent: bool, frame: Frame) -> str:
    """What a good frame is, in the protocol's words."""
    name = ''
    for part in decoder(line, sent).explain(frame.raw):
        if part.kind is not None:
            name = part.kind or f'{name or "type"} 0x{part.raw:02x}'
    return name or f'type 0x{frame.type:02x}'


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
