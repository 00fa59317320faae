"""The settings of a serial line from the command line, and a decoder for each direction."""
import argparse
from typing import Any, Mapping, NamedTuple

from ...boards import BOARDS, BoardError, description
from ...simulation.arguments import (board_packages, board_parameters, read_parameters,
                                     url_argument)
from ...boards.description import Description
from ...framing.stream import Decoder
from .show import WireError

_MAX_BAUD = 10 ** 8


class UsageError(WireError):
    """An argument of the command line cannot be used."""

    status = 2


class Settings(NamedTuple):
    """What is needed to decode a line."""

    board: Description
    baud: int
    parameters: Mapping[str, Any] = {}       # the board's, as the bridge has them


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add LINK, and the options that change how its bytes are decoded."""
    parser.add_argument('link', metavar='LINK',
                        help='the protocol: ' + ', '.join(BOARDS) + ', a link of a board in '
                             '--config, or a package with a board')
    parser.add_argument('--config', default='', metavar='FILE',
                        help="the bridge's parameters, for its baud rates, its custom messages and "
                             'functions, and its boards of other packages')
    parser.set_defaults(baud=0)


def add_port(parser: argparse.ArgumentParser) -> None:
    """Add PORT, and its baud rate."""
    parser.add_argument('port', metavar='PORT', type=url_argument,
                        help='a device, or whatever pyserial opens')
    parser.add_argument('--baud', type=_baud, default=0, metavar='N',
                        help="(that of --config, or the board's default)")


def _baud(text: str) -> int:
    value = int(text)
    if not 0 < value <= _MAX_BAUD:
        raise argparse.ArgumentTypeError(f'{text} baud is out of range (1 … {_MAX_BAUD})')
    return value


def settings(options: argparse.Namespace) -> Settings:
    """Return the settings from the command line.

    Raises:
        UsageError: the link is unknown, or --config cannot be used.
    """
    try:
        parameters = read_parameters(options.config) if options.config else {}
        others = () if options.link in BOARDS else map(description, board_packages(parameters))
        board = next((each for each in others if each.name == options.link), None) \
            or description(options.link)
        own = board_parameters(parameters, board.name)
        line = Settings(board, options.baud or board.baud_of(own), own)
        decoder(line, False)
    except BoardError as error:
        raise UsageError(f'there is no board {options.link}, only {", ".join(BOARDS)}; for a board '
                         'of another package give its package, or --config with the parameter '
                         f'`boards`: {error}') from None
    except (OSError, ValueError) as error:
        raise UsageError(f'{options.config}: {error}') from None
    return line


def decoder(line: Settings, sent: bool) -> Decoder:
    """Return a decoder of what the board sends, or of what is `sent` to it."""
    return line.board.decoder(sent, line.parameters)
