"""What a board is, in types: all that programs ask of one.

A board's folder has one in its `__init__.py`, as `DESCRIPTION`. It imports the board's `wire`
alone; the modules with the link, with ROS and with the simulator are imported when they are asked
for.
"""
import enum
import importlib
from dataclasses import dataclass, field
from typing import Any, Callable, List, Mapping, NamedTuple, Optional, Tuple


class Topic(NamedTuple):
    """A topic that the board's data is published on. `name` is relative to the node: ~imu,
    mcu/status."""

    name: str
    type: str                         # as ROS has it: package/Type
    period: Optional[float] = None    # s from one message to the next; None: not known
    period_parameter: str = ''        # the board's parameter that has the period
    ages: bool = True                 # False: comes on change alone, so that no age is too old
    optional: bool = False            # only some boards send it


class CustomRows(NamedTuple):
    """The rows of parameters that make custom messages or functions."""

    parameter: str                        # of the board's, which holds them by name
    read: Callable[[Any], List[Any]]      # RowError for the first mistake
    prefix: str                           # before a row's name, for the name of its topic


class Command(enum.Enum):
    """What the `command` of a frame is."""

    NOTHING = 'nothing'
    FUNCTION = 'function'    # what is asked; the board sends replies alone, one a request
    SEQUENCE = 'sequence'    # a running number, modulo 256


class Heartbeat(NamedTuple):
    """What is to be sent steadily."""

    type: int
    longest_gap: float       # s after which the board stops its motor


@dataclass(frozen=True)
class Description:
    """One board."""

    name: str       # of its link, in logs, diagnostics, serial_msg and parameters
    package: str    # its folder, as Python imports it: __name__
    # (sent, parameters): a decoder of what is sent to the board, or of what the board sends, as
    # the board's own parameters have it; RowError for a mistake in them. A name that is not there
    # has its default.
    decoder: Callable[[bool, Mapping[str, Any]], Any]
    title: str = ''    # what it is, for people: model car
    topics: Tuple[Topic, ...] = ()
    other_names: Tuple[str, ...] = ()        # of topics with commands, and of services
    custom: Optional[CustomRows] = None
    # Parameters, false by default, that change how the bytes are read: what each means.
    wire_flags: Mapping[str, str] = field(default_factory=dict)
    command: Command = Command.NOTHING
    heartbeat: Optional[Heartbeat] = None
    between: bytes = b''             # bytes that may stand between frames
    first_after_loss: bytes = b''    # is sent first after a part of what was sent has been dropped

    @property
    def interface(self) -> Any:
        """Its class on the ROS side: see `ros.interface.Interface`."""
        return importlib.import_module(self.package + '.ros').INTERFACE

    @property
    def simulator(self) -> Any:
        """The class of the simulated board: see `simulation.board.Board`."""
        return importlib.import_module(self.package + '.simulator').BOARD
