"""The boards: one folder each, the list of them, and functions that find one by its name.

    boards/NAME/__init__.py     `DESCRIPTION`, which programs read: see description.py
                wire.py         bytes <-> typed messages; pure
                link.py         the open port: session rules, counters; no rospy
                ros.py          `INTERFACE`, topics and services: see ros/interface.py
                simulator.py    `BOARD`, the simulated board: see simulation/board.py

Other files there belong to one board only. A board of another package has the same folder
elsewhere; its name is the package's import name. A board is imported only when it is asked for, so
the simulators need no ROS.
"""
import importlib
import traceback
from types import ModuleType
from typing import Iterable, Tuple

from .description import Description

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


def find(name: str, packages: Iterable[str] = ()) -> Description:
    """The board whose link has this name.

    Args:
        name: name of a link, or import name of a package with a board.
        packages: import names of packages with boards, as in the bridge's parameter `boards`.

    Raises:
        BoardError: there is no such board.
    """
    if name in BOARDS:
        return description(name)
    for package in packages:
        other = description(package)
        if other.name == name:
            return other
    return description(name)


def load(name: str) -> ModuleType:
    """Import a module.

    Raises:
        BoardError: there is no such module, or importing it raised any exception (SystemExit
            included).
    """
    try:
        return importlib.import_module(name)
    except BaseException as error:  # pylint: disable=broad-except
        raise BoardError(f'importing {name!r} failed: {reason(error)}') from None


def reason(error: BaseException) -> str:
    """The text of a caught exception and the place that raised it, in one line.

    The caller's own stack frame is left out.
    """
    what = ' '.join(traceback.format_exception_only(type(error), error)[-1].split())
    if len(what) > 200:
        what = what[:199] + '…'
    places = [(frame.filename, frame.lineno)
              for frame in traceback.extract_tb(error.__traceback__)[1:]
              if frame.filename[:1] != '<' and frame.filename != importlib.__file__]
    if isinstance(error, SyntaxError):
        places.append((error.filename or '?', error.lineno or 0))
    return f'{what} ({places[-1][0]}, line {places[-1][1]})' if places else what
