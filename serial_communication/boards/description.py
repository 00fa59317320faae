"""The description of a board: what the programs need to know about it.

The `__init__.py` of a board's folder holds it as `DESCRIPTION` and imports only the board's `wire`.
The modules with the link, ROS and the simulator are imported when they are used.
"""
import importlib
import math
from dataclasses import dataclass
from typing import Any, Callable, List, Mapping, NamedTuple, Optional, Set, Tuple

from ..framing.row_reader import Group
from ..framing.rows import BOARD, Kind, Row, RowError
from ..framing.stream import Decoder

BAUD_RANGE = 50, 4000000    # of a port
ANNOUNCED_GROUP = 'announced'     # parameter of a board: the announced rows that the bridge uses


class Topic(NamedTuple):
    """A topic with data of the board. `name` is relative to the node: ~imu, mcu/status."""

    name: str
    type: str                         # ROS type: package/Type
    period: Optional[float] = None    # s between two messages; None: not known
    period_parameter: str = ''        # name of the board's parameter with the period
    ages: bool = True                 # False: published on change only, so it never becomes stale
    optional: bool = False            # only some boards send it


class Field(NamedTuple):
    """What a form shows of a field of a request, beyond its type."""

    name: str
    unit: str = ''
    minimum: float = -math.inf
    maximum: float = math.inf
    preset: Optional[float] = None
    choices: Tuple[Tuple[str, int], ...] = ()    # label and value of each; each becomes a button


class Service(NamedTuple):
    """A service of the board, for programs that offer it to people. `name` is as a topic's."""

    name: str
    type: str                         # ROS type: package/Type
    title: str
    fields: Tuple[Field, ...] = ()    # those of the request that need more than their type
    confirm: str = ''                 # what to tell before it is called; '': nothing


@dataclass(frozen=True)
class Description:
    """One board."""

    name: str       # of its link in logs, diagnostics, serial_msg and parameters
    package: str    # import name of its folder: __name__
    # decoder(sent, parameters) returns a decoder of what is sent to the board (sent is true) or of
    # what the board sends, with these parameters of the board; RowError for a mistake in them.
    decoder: Callable[[bool, Mapping[str, Any]], Decoder]
    title: str = ''    # what it is, for people: model car
    rows: Tuple[Row, ...] = ()               # that are built in and need no code of their own
    groups: Tuple[Group, ...] = ()           # the rows that parameters and the board may add
    topics: Tuple[Topic, ...] = ()           # with code of their own
    services: Tuple[Service, ...] = ()       # that the page offers
    other_names: Tuple[str, ...] = ()        # of other topics and services
    longest_gap: Optional[float] = None      # s without heartbeat; then the board stops its motor
    baud: int = 115200               # of the port, if its parameters have none: see `baud_of`
    reset_line: str = ''             # `dtr` or `rts`, which resets the board; '': none does
    # Bytes that end a frame, are never inside one, and may also separate two frames.
    between: bytes = b''
    # A frame that changes nothing, for a board that is silent until it is asked.
    question: bytes = b''

    @property
    def published(self) -> List[Topic]:
        """All of its topics with data: its own, and those of built-in rows."""
        return [*self.topics, *(
            Topic(self.name_of(row), row.ros_type, row.period or None)
            for row in self.rows if row.kind is Kind.FROM)]

    @property
    def names(self) -> Set[str]:
        """The names of its topics and services, relative to the node."""
        return {*(topic.name for topic in self.topics), *map(self.name_of, self.rows),
                *(service.name for service in self.services), *self.other_names}

    def name_of(self, row: Row) -> str:
        """The name of a row's topic, service or parameter, likewise."""
        return next(group.prefix for group in self.groups if row.kind in group.kinds) + row.name

    def read(self, parameter: str, given: Any) -> List[Any]:
        """The rows in one of the parameters `groups`; RowError for the first mistake."""
        group = next(each for each in self.groups if each.parameter == parameter)
        return group.read(given, f'{self.name}/{parameter}')

    def read_all(self, parameters: Mapping[str, Any]) -> List[Any]:
        """The rows in all parameters of the board; RowError for the first mistake."""
        return [row for group in self.groups
                for row in self.read(group.parameter, parameters.get(group.parameter) or {})]

    def read_announced(self, name: str, given: Any) -> Any:
        """The row that the board announces by this name; RowError for a mistake."""
        row, = self.group_of(given).read({name: given}, f'{self.name}/{ANNOUNCED_GROUP}', BOARD)
        return row

    def group_of(self, given: Any) -> Group:
        """What a row, as a board announces it, is one of."""
        is_setting = isinstance(given, dict) and 'setting' in given
        return next((group for group in self.groups
                     if (Kind.SETTING in group.kinds) == is_setting), self.groups[0])

    def baud_of(self, parameters: Mapping[str, Any]) -> int:
        """The rate of the port: `baud` of the board's parameters, else the description's; RowError
        if the parameter is not a rate that the bridge accepts."""
        given = parameters.get('baud', self.baud)
        if type(given) is not int or not BAUD_RANGE[0] <= given <= BAUD_RANGE[1]:
            raise RowError(f'{self.name}/baud', given, 'may be a whole number from {} to {} '
                           '(baud)'.format(*BAUD_RANGE))
        return given

    @property
    def binder(self) -> Any:
        """The board's class on the ROS side: a subclass of `ros.binder.Binder`."""
        return importlib.import_module(self.package + '.ros').BoardBinder
