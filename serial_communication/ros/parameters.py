"""The private parameters of the node and of every board: their types, ranges and defaults.

config/bridge.yaml documents them for users; a test compares the two. RowError: a value is wrong.
"""
from functools import partial
from math import inf, isfinite
from typing import Any, Callable, Dict, List, NamedTuple, Tuple

import rospy

from ..boards import descriptions
from ..boards.description import BAUD_RANGE
from ..framing.rows import RowError, Setting
from ..transport.urls import check_url, identity
from .rows import read_rows, rows_in

_KINDS = {bool: 'true or false', str: 'text', int: 'a whole number', float: 'a number',
          dict: 'a group'}
_COMMON = 'serial_msg', '~get_loggers', '~set_logger_level', '~stop'     # names of any bridge


class NameTaken(ValueError):
    """Two topics or services have one name; the text is a line for users."""


class Parameter(NamedTuple):
    """One parameter. Its type is that of its default.

    A list has as many numbers as its default. An empty list and a group (a dict) are checked by
    `parse` alone.
    """

    default: Any
    low: float = -inf
    high: float = inf
    choices: Tuple = ()
    unit: str = ''
    parse: Callable[[Any], Any] = lambda value: value    # returns it; ValueError if it is wrong

    def allowed(self) -> str:
        """Return the allowed values as text, such as ``may be a number from 0 to 1 (s)``."""
        if self.choices:
            return 'may be ' + ' or '.join(repr(choice) for choice in self.choices)
        kind = _KINDS.get(type(self.default)) or (
            f'a list of {len(self.default)} numbers' if self.default else 'a list')
        bounds = f' from {self.low:g} to {self.high:.10g}' if isfinite(self.low) else ''
        return f'may be {kind}{bounds}' + (f' ({self.unit})' if self.unit else '')

    def checked(self, key: str, value: Any) -> Any:
        """Return the value of the parameter `key`, as the parameter's type."""
        try:
            return self.parse(value if self.default in ({}, []) else self._typed(value))
        except RowError:
            raise
        except (ValueError, OverflowError) as error:
            raise RowError(key, value, ': '.join(filter(None, (self.allowed(), str(error))))
                           ) from None

    def _typed(self, value: Any) -> Any:
        kind = type(self.default)
        if kind is float and type(value) is int:
            value = float(value)
        if type(value) is not kind or self.choices and value not in self.choices:
            raise ValueError
        if kind in (int, float) and not self.low <= value <= self.high:
            raise ValueError    # NaN fails this as well
        if kind is list:
            if len(value) != len(self.default) or not all(
                    type(item) in (int, float) and isfinite(item) for item in value):
                raise ValueError
            value = [float(item) for item in value]
        return value


Parameters = Dict[str, Parameter]     # by name; a board's without the prefix ``BOARD/``


def seconds(default: float, low: float, high: float) -> Parameter:
    """Return a parameter that is a time; all values in s."""
    return Parameter(default, low, high, unit='s')


def frame_id(default: str) -> Parameter:
    """Return a parameter that is a frame id; its name has to end in ``frame_id``."""
    return Parameter(default, parse=_only_if(bool))


def _only_if(is_right: Callable[[Any], bool]) -> Callable[[Any], Any]:
    def parse(value: Any) -> Any:
        if not is_right(value):
            raise ValueError
        return value
    return parse


def _port(url: str) -> str:
    if url:
        check_url(url)
    return url


MOUNT = Parameter([0.0] * 6, unit='x y z in m, roll pitch yaw in rad, in base_frame_id')
NODE_PARAMETERS: Parameters = {
    'boards': Parameter([], unit='names of Python packages with a board', parse=_only_if(
        lambda given: type(given) is list and all(type(each) is str for each in given))),
    'frame_timeout': seconds(0.05, 0.001, 10.0),
    'publish_tf': Parameter(False),
    'base_frame_id': frame_id('base_link'),
    'frame_prefix': Parameter(''),
    'settings': Parameter({}, unit='values by link and name: {arduino: {kp: 2.0}}', parse=_only_if(
        lambda given: type(given) is dict and all(type(each) is dict for each in given.values()))),
}


def parameters_of(binder: Any) -> Parameters:
    """Return the parameters of a board, a subclass of `Binder`: those of any, and its own."""
    board = binder.BOARD
    return {
        'port': Parameter('', parse=_port),     # empty: the link is off
        'baud': Parameter(board.baud, *BAUD_RANGE, unit='baud'),
        'reset_line': Parameter(board.reset_line, choices=('', 'dtr', 'rts')),
        'announcements': Parameter(True),
        **{group.parameter: Parameter({}, parse=partial(read_rows, board, group.parameter))
           for group in board.groups},
        **binder.PARAMETERS}


def check(given: Any) -> Tuple[Dict[str, Any], Dict[Any, Dict[str, Any]], List[str]]:
    """Return the values of the node; for each board's binder those of the board and the node; and
    the names that are unknown. Frame ids have `frame_prefix` before them.

    Args:
        given: the node's parameters as the parameter server holds them. Whatever the import of
            another package's board raises is raised.
    """
    unknown: List[str] = []
    packages = NODE_PARAMETERS['boards'].checked('boards', given.get('boards', []))
    binders = {board.name: board.binder for board in descriptions(packages)}
    node = _values(NODE_PARAMETERS, {name: value for name, value in given.items()
                                     if name not in binders}, '', unknown)
    boards = {binder: {**node, **_values(parameters_of(binder), given.get(name, {}), name + '/',
                                         unknown)} for name, binder in binders.items()}
    for values in (node, *boards.values()):
        for name in values:
            if name.endswith('frame_id'):
                values[name] = node['frame_prefix'] + values[name]
    ports: Dict[Any, str] = {}
    for name, values in zip(binders, boards.values()):
        port = identity(values['port']) if values['port'] else None
        if port and ports.setdefault(port, name) != name:      # it would wait for it for ever
            raise RowError(f'{name}/port', values['port'],
                           f'is also the port of {ports[port]}; each link needs its own')
        for row in (each.row for each in rows_in(values) if isinstance(each.row, Setting)):
            value = node['settings'].get(name, {}).get(row.name, row.default)
            try:
                row.checked(value)
            except ValueError as error:
                raise RowError(f'settings/{name}/{row.name}', value, str(error)) from None
    return node, boards, unknown


def _values(parameters: Parameters, given: Any, prefix: str, unknown: List[str]) -> Dict[str, Any]:
    if not isinstance(given, dict):
        raise RowError(prefix[:-1], given, 'may be a group of parameters')
    unknown += [prefix + name for name in sorted(given) if name not in parameters]
    return {name: parameter.checked(prefix + name, given.get(name, parameter.default))
            for name, parameter in parameters.items()}


def resolved_names(boards: Dict[Any, Dict[str, Any]]) -> Dict[str, str]:
    """Return the resolved names of all topics and services, and whose each is. NameTaken: two have
    one, by a remapping or because of the node's own name; rospy would mix them in silence."""
    names = {rospy.resolve_name(name): name for name in _COMMON}
    for binder, values in boards.items():
        named = [*((name, name) for name in sorted(binder.BOARD.names)),
                 *((each.name, each.row.key) for each in rows_in(values))]
        for name, user in named if values['port'] else ():
            full = rospy.resolve_name(name)
            if full in names:
                raise NameTaken(
                    f'{full} is the name of {names[full]} and of {user}: each topic and service '
                    'needs its own; give the node another name, or remap one of them')
            names[full] = user
    return names
