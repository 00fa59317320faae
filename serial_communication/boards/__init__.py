"""The boards: one folder each, the list of them, and their descriptions.

CONTRIBUTING.md lists the files of a board's folder. The folder of a board of another package is
elsewhere; its name is the package's import name. A board is imported only when it is asked for, so
the simulators need no ROS.
"""
import importlib
from typing import Iterable, List, Tuple

from .description import Description

BOARDS: Tuple[str, ...] = ('bus', 'arduino', 'mcu')


class BoardError(ImportError):
    """There is no such board; the text is one line."""


def description(name: str) -> Description:
    """The description of a board: one of `BOARDS`, or of the package with that import name.

    BoardError if there is none; and whatever importing it raises.
    """
    try:
        return importlib.import_module(f'{__name__}.{name}' if name in BOARDS else name).DESCRIPTION
    except (ImportError, AttributeError, ValueError, TypeError) as error:
        raise BoardError(str(error)) from error


def descriptions(packages: Iterable[str] = ()) -> List[Description]:
    """The boards of this package, in order, and those of other packages; BoardError if one cannot
    be found."""
    return [description(name) for name in (*BOARDS, *packages)]
