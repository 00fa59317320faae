"""A serial line as the command line has it: its settings, and a decoder for each direction."""
import argparse
import sys
from typing import Any, Mapping, NamedTuple

from ...boards import BOARDS, BoardError, description
from ...simulation.arguments import (board_packages, board_parameters, read_parameters,
                                     url_argument)
from ...boards.description import Description
from ...framing.stream import Decoder


class WireError(Exception):
    """Ends the program; its text is one line for the user."""

    status = 1     # exit status of the program


class UsageError(WireError):
    """An argument of the command line cannot be used."""

    status = 2


class Settings(NamedTuple):
    """What is needed to decode a line."""

    board: Description
    baud: int
    parameters: Mapping[str, Any] = {}       # the board's, as the bridge has them

    def decoder(self, sent: bool = False) -> Decoder:
        """A decoder of what the board sends, or of what is `sent` to it."""
        return self.board.decoder(sent, self.parameters)


def settings_of(board: Description, parameters: Any, **more: Any) -> Settings:
    """The settings of a board by the bridge's parameters, and `more` of the board's; RowError for
    a mistake in them."""
    own = {**board_parameters(parameters, board.name), **more}
    line = Settings(board, board.baud_of(own), own)
    line.decoder()
    return line


def add_options(parser: argparse.ArgumentParser, with_port: bool = False) -> None:
    """Add LINK and --config; and PORT with its baud rate."""
    parser.add_argument('link', metavar='LINK',
                        help='the protocol: ' + ', '.join(BOARDS) + ', a link of a board in '
                             '--config, or a package with a board')
    parser.add_argument('--config', default='', metavar='FILE',
                        help="the bridge's parameters, for its baud rates, its custom messages and "
                             'functions, and its boards of other packages')
    parser.set_defaults(baud=None)
    if with_port:
        parser.add_argument('port', metavar='PORT', type=url_argument,
                            help='a device, or whatever pyserial opens')
        parser.add_argument('--baud', type=int, metavar='N',
                            help="(that of --config, or the board's default)")


def settings(options: argparse.Namespace) -> Settings:
    """The settings from the command line; UsageError if the link is unknown, or --config or --baud
    cannot be used."""
    try:
        parameters = read_parameters(options.config) if options.config else {}
        others = () if options.link in BOARDS else map(description, board_packages(parameters))
        board = next((each for each in others if each.name == options.link), None) \
            or description(options.link)
        return settings_of(board, parameters, **({} if options.baud is None else
                                                 {'baud': options.baud}))
    except BoardError as error:
        raise UsageError(f'there is no board {options.link}, only {", ".join(BOARDS)}; for a board '
                         'of another package give its package, or --config with the parameter '
                         f'`boards`: {error}') from None
    except (OSError, ValueError) as error:
        raise UsageError(str(error)) from None


def note(text: str) -> None:
    """Print a line on standard error."""
    print(text, file=sys.stderr)
