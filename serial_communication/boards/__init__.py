"""The boards: one folder each, the list of them, and functions that find one by its name.

doc/developing.md lists the files of a board's folder. The folder of a board of another package is
elsewhere; its name is the package's import name. A board is imported only when it is asked for, so
the simulators need no ROS.
"""
import importlib
import traceback
from types import ModuleType
from typing import Iterable, List, Tuple

from .description import Description, named_twice

BOARDS: Tuple[str, ...] = ('bus', 'arduino', 'mcu')


class BoardError(ImportError):
    """A board cannot be imported, or its module describes no board; the text is one line."""


def description(name: str) -> Description:
    """The description of a board.

    Args:
        name: one of `BOARDS`, or the import name of a package with a board.

    Raises:
        BoardError: the module cannot be imported, or has no `DESCRIPTION`.
    """
    found = getattr(load(f'{__name__}.{name}' if name in BOARDS else name), 'DESCRIPTION', None)
    if not isinstance(found, Description):
        raise BoardError(f'the module {name!r} has no DESCRIPTION of a board')
    return found


def descriptions(packages: Iterable[str] = ()) -> List[Description]:
    """The boards of this package, in order, and those of other packages.

    Raises:
        BoardError: one cannot be imported, or two of this package have a topic or a service of the
            same name.
    """
    found = [description(name) for name in BOARDS]
    twice = named_twice([name for board in found for name in board.names])
    if twice:
        raise BoardError(f'two boards name a topic or service {twice}')
    return found + [description(package) for package in packages]


def find(name: str, packages: Iterable[str] = ()) -> Description:
    """The board whose link has this name, of this package or of `packages`; or the board of the
    package `name`. BoardError if there is none."""
    for board in () if name in BOARDS else map(description, packages):
        if board.name == name:
            return board
    return description(name)


def load(name: str) -> ModuleType:
    """Import a module; BoardError if there is none, or importing it raised anything."""
    try:
        return importlib.import_module(name)
    except BaseException as error:  # pylint: disable=broad-except
        raise BoardError(f'importing {name!r} failed: {reason(error)}') from None


def reason(error: BaseException) -> str:
    """The text of a caught exception and the place that raised it, below the caller's own stack
    frame; in one line."""
    what = ' '.join(traceback.format_exception_only(type(error), error)[-1].split())
    what = what if len(what) <= 200 else what[:199] + '…'
    places = [(frame.filename, frame.lineno)
              for frame in traceback.extract_tb(error.__traceback__)[1:]
              if frame.filename[:1] != '<' and frame.filename != importlib.__file__]
    if isinstance(error, SyntaxError):
        places.append((error.filename or '?', error.lineno or 0))
    return f'{what} ({places[-1][0]}, line {places[-1][1]})' if places else what
