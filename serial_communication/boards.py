"""The boards: the one list that node, simulators, demo, campaign and scripts go by.

A board is a name and a module of that name on each floor that it needs:

    serial_communication.ros.NAME           `INTERFACE`, its link with topics and services: see
                                            ros/interface.py
    serial_communication.simulation.NAME    `BOARD`, the other end of its line: see
                                            simulation/board.py

A board of another package is the full name of a module with the same attribute: in the node's
parameter `boards` one with `INTERFACE`, on the simulator's command line one with `BOARD`. Nothing
is imported until somebody asks, so the simulators need no ROS.
"""
import importlib
import traceback
from types import ModuleType
from typing import Tuple

BOARDS: Tuple[str, ...] = ('bus', 'arduino', 'mcu')


class BoardError(ImportError):
    """A board's module cannot be imported; the text is one line."""


def board_module(floor: str, name: str) -> ModuleType:
    """The module of a board on a floor (`ros` or `simulation`).

    Args:
        name: one of `BOARDS`, or the full name of a module of another package.

    Raises:
        BoardError: there is no such module, or it raises whatever it may be (also SystemExit:
            a module that calls sys.exit).
    """
    if name in BOARDS:
        name = f'serial_communication.{floor}.{name}'
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
