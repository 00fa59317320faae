"""The boards: a folder each, the list of them, and how one is found by its name.

    boards/NAME/__init__.py     `DESCRIPTION`, by which programs go: see description.py
                wire.py         bytes <-> typed messages; pure
                link.py         the open port: session rules, counters; no rospy
                ros.py          `INTERFACE`, topics and services: see ros/interface.py
                simulator.py    `BOARD`, the other end of the line: see simulation/board.py

and what only that board has. A board of another package is such a folder elsewhere, and is named as
Python imports it. Nothing is imported until somebody asks, so that the simulators need no ROS.
"""
import importlib
import traceback
from types import ModuleType
from typing import Iterable, Tuple

from .description import Description

BOARDS: Tuple[str, ...] = ('bus', 'arduino', 'mcu')


class BoardError(ImportError):
    """A board cannot be imported, or is none; the text is one line."""


def description(name: str) -> Description:
    """The description of a board.

    Args:
        name: one of `BOARDS`, or a package with a board, as Python imports it.

    Raises:
        BoardError: it cannot be imported, or has no `DESCRIPTION`.
    """
    found = getattr(load(f'{__name__}.{name}' if name in BOARDS else name), 'DESCRIPTION', None)
    if not isinstance(found, Description):
        raise BoardError(f'the module {name!r} has no DESCRIPTION of a board')
    return found


def find(name: str, packages: Iterable[str] = ()) -> Description:
    """The board with the link of this name.

    Args:
        name: of a link, or of a package with a board.
        packages: with boards, as the bridge's parameter `boards` names them.

    Raises:
        BoardError: there is none.
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
        BoardError: there is no such module, or it raises whatever it may be (also SystemExit:
            a module that calls sys.exit).
    """
    try:
        return importlib.import_module(name)
    except BaseException as error:  # pylint: disable=broad-except
        raise BoardError(f'importing {name!r} failed: {reason(error)}') from None


def reason(error: BaseException) -> str:
    """What code of another package raised, and where, in one line; by who has caught it."""
    what = ' '.join(traceback.format_exception_only(type(error), error)[-1].split())
    if len(what) > 200:
        what = what[:199] + '…'
    places = [(frame.filename, frame.lineno)
              for frame in traceback.extract_tb(error.__traceback__)[1:]
              if frame.filename[:1] != '<' and frame.filename != importlib.__file__]
    if isinstance(error, SyntaxError):
        places.append((error.filename or '?', error.lineno or 0))
    return f'{what} ({places[-1][0]}, line {places[-1][1]})' if places else what
