"""rosrun serial_communication header: a C++ header for the sketch, from a configuration's rows.

Prints a C++11 header: a packed struct for each custom message, or for the request and the reply of
each custom function, with its type number, its scale and its limits; the list of the settings, with
their limits and the values that the file wants; and the text with which the board announces its
rows. It needs no ROS master, and the same file makes the same bytes.
"""
import argparse
import os
import signal
import sys
from typing import Any, Dict, List, Optional

from ...boards import BOARDS, BoardError, descriptions, find
from ...boards.config_file import board_packages, board_parameters, read_parameters
from ...boards.description import CustomRows, Description
from ...framing.settings import Setting
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
        board = _board(parameters, link)
        given = [part for part in _parts(board) if _rows(parameters, board, part)]
        parts = given or _parts(board)[:1]
        rows = [_rows(parameters, board, part) for part in parts]
        read = [row for part, given in zip(parts, rows) for row in part.read(given)]
        values = _values(parameters, board, read)
    except OSError as error:
        raise _Mistake(error.strerror) from None
    except (BoardError, ValueError) as error:
        raise _Mistake(error) from None
    names = [row.name for row in read]
    if len(set(names)) < len(names):
        raise _Mistake(f'has two rows {max(names, key=names.count)}, and an announcement one of a '
                       'name')
    return header(os.path.basename(path), board.name, read, values,
                  {name: row for given in rows for name, row in given.items()})


def _board(parameters: Dict[str, Any], link: str) -> Description:
    """The board with that link; '': the only one with rows."""
    packages = board_packages(parameters)
    if link:
        try:
            board = find(link, packages)
        except BoardError as error:
            raise _WrongLink(f'there is no board {link}, only {", ".join(BOARDS)}: '
                             f'{error}') from None
        if not board.custom:
            raise _WrongLink(f'the board {link} has no custom messages')
        return board
    boards = [board for board in descriptions(packages)
              if any(_rows(parameters, board, part) for part in _parts(board))]
    names = [board.name for board in boards]
    if not boards:
        raise _Mistake('has no custom messages: no rows in ' + ', '.join(
            f'{board.name}/{part.parameter}' for board in descriptions()
            for part in _parts(board)))
    if len(boards) > 1:
        raise _WrongLink(f'has rows of {" and ".join(names)}; a header is for one board: name it '
                         f'after the file, as {names[-1]}')
    return boards[0]


def _parts(board: Description) -> List[CustomRows]:
    return [part for part in (board.custom, board.settings) if part]


def _rows(parameters: Dict[str, Any], board: Description, part: CustomRows) -> Any:
    return board_parameters(parameters, board.name).get(part.parameter)


def _values(parameters: Dict[str, Any], board: Description, read: List[Any]) -> Dict[str, Any]:
    """What the settings are at the start: as the file wants it, or as near to 0 as it may be."""
    wanted = board_parameters(parameters.get('settings') or {}, board.name)
    values = {}
    for row in read:
        if isinstance(row, Setting):
            try:
                values[row.name] = row.checked(wanted.get(row.name, row.default))
            except ValueError as error:
                raise ValueError(f'settings/{board.name}/{row.name} is {wanted[row.name]!r}, '
                                 f'{error}') from None
    return values
