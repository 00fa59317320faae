"""rosrun serial_communication header: a C++ header for the sketch, from a configuration's rows.

Prints a C++11 header: a packed struct for each custom message, or for the request and the reply of
each custom function, with its type number, its scale and its limits; and the text with which the
board announces its rows. It needs no ROS master, and the same file makes the same bytes.
"""
import argparse
import os
import signal
import sys
from typing import Any, Dict, List, Optional, Tuple

from ...boards import BOARDS, BoardError, descriptions, find
from ...boards.config_file import board_packages, board_parameters, read_parameters
from ...boards.description import CustomRows, Description
from ...output import prepare_output
from .cpp import header

_EXAMPLES = """\
example:
  rosrun serial_communication header my_robot.yaml arduino > my_robot.h
"""


class _Mistake(Exception):
    """The file cannot be used; the text is one line."""

    status = 1


class _WrongLink(_Mistake):
    """LINK is wrong or missing."""

    status = 2


def main(arguments: Optional[List[str]] = None) -> int:
    """Print the header and return the exit status."""
    prepare_output()
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    options = _arguments(arguments)
    try:
        print(_header(options.file, options.link), end='')
    except _Mistake as error:
        print(f'header: {options.file}: {error}', file=sys.stderr)
        return error.status
    return 0


def _arguments(arguments: Optional[List[str]]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog='header', epilog=_EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
        description=__doc__.partition('\n\n')[2])
    parser.add_argument('file', metavar='FILE', help="the bridge's parameters, as for config:=")
    parser.add_argument('link', metavar='LINK', nargs='?', default='',
                        help='the board: ' + ', '.join(BOARDS) + ', or one of another package; '
                             'not needed if only one has rows')
    return parser.parse_args(arguments)


def _header(path: str, link: str) -> str:
    try:
        parameters = read_parameters(path)
        board, custom = _board(parameters, link)
        rows = _rows(parameters, board)
        read = custom.read(rows)
    except OSError as error:
        raise _Mistake(error.strerror) from None
    except (BoardError, ValueError) as error:
        raise _Mistake(error) from None
    return header(os.path.basename(path), board.name, read, rows)


def _board(parameters: Dict[str, Any], link: str) -> Tuple[Description, CustomRows]:
    """The board with that link; '': the only one with rows. And how its rows are read."""
    packages = board_packages(parameters)
    if link:
        try:
            board = find(link, packages)
        except BoardError as error:
            raise _WrongLink(f'there is no board {link}, only {", ".join(BOARDS)}: '
                             f'{error}') from None
        if not board.custom:
            raise _WrongLink(f'the board {link} has no custom messages')
        return board, board.custom
    boards = [(board, board.custom) for board in descriptions(packages)
              if board.custom and _rows(parameters, board)]
    names = [board.name for board, _ in boards]
    if not boards:
        raise _Mistake('has no custom messages: no rows in ' + ', '.join(
            f'{board.name}/{board.custom.parameter}' for board in descriptions()
            if board.custom))
    if len(boards) > 1:
        raise _WrongLink(f'has rows of {" and ".join(names)}; a header is for one board: name it '
                         f'after the file, as {names[-1]}')
    return boards[0]


def _rows(parameters: Dict[str, Any], board: Description) -> Any:
    return board.custom and board_parameters(parameters, board.name).get(board.custom.parameter)
