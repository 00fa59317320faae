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
from types import ModuleType
from typing import Tuple

BOARDS: Tuple[str, ...] = ('bus', 'arduino', 'mcu')


def board_module(floor: str, name: str) -> ModuleType:
    """The module of a board on a floor (`ros` or `simulation`).

    Args:
        name: one of `BOARDS`, or the full name of a module of another package.

    Raises:
        ImportError: there is no such module.
    """
    if name in BOARDS:
        name = f'serial_communication.{floor}.{name}'
    return importlib.import_module(name)
