"""The private parameters of the node and of every board.

config/bridge.yaml documents them for users; a test compares the two.
"""
import importlib
import xmlrpc.client
from typing import Any, Dict, List, Tuple, Type

import rospy

from ..boards import BOARDS, description
from ..boards.description import ANNOUNCED
from ..framing.rows import RowError
from ..framing.layout import brief, readable
from ..transport.urls import identity
from .interface import Interface
from .parameter import (RESET_LINE, Parameter, ParameterError, Parameters, frame_id, not_empty,
                        seconds)
from .rows import rows_in
from .settings import start_values

_COMMON = 'serial_msg', '~get_loggers', '~set_logger_level', '~stop'     # names of any bridge


def _names(given: Any) -> List[str]:
    if not isinstance(given, list) or not all(isinstance(name, str) for name in given):
        raise ValueError
    return given


NODE_PARAMETERS: Parameters = {
    'boards': Parameter([], unit='names of Python packages with a board', parse=_names),
    'frame_timeout': seconds(0.05, 0.001, 10.0),
    'publish_tf': Parameter(False),
    'base_frame_id': frame_id('base_link'),
    'frame_prefix': Parameter(''),
    'settings': Parameter({}, parse=start_values),
}
BUILT_IN: List[Type[Interface]] = [description(name).interface for name in BOARDS]


def table(interfaces: List[Type[Interface]]) -> Parameters:
    """Return all parameters by full name; a board's are in a group with the board's name."""
    return {**NODE_PARAMETERS, **{f'{interface.NAME}/{name}': parameter
                                  for interface in interfaces
                                  for name, parameter in _of_interface(interface).items()}}


def _of_interface(interface: Type[Interface]) -> Parameters:
    """Its parameters, and the one that every board has."""
    return {'reset_line': RESET_LINE, **interface.PARAMETERS}


PARAMETERS = table(BUILT_IN)


def check(given: Dict[str, Any], namespace: str) -> Tuple[Dict[str, Any], List[str]]:
    """Return the values of all parameters, and a warning for each unknown name.

    Frame ids have `frame_prefix` before them. `boards` has the interfaces of all boards.

    Args:
        given: the tree that the parameter server holds under `namespace`.

    Raises:
        ParameterError: a value is wrong; the text names the parameter, its value and what it may
            be.
        Exception: whatever the import of another package's board raises.
    """
    if not isinstance(given, dict):
        raise _not_a_group(namespace, given)
    given = dict(given)
    interfaces = BUILT_IN + _of_packages(
        _value('boards', NODE_PARAMETERS['boards'], given.pop('boards', []), namespace), namespace)
    parameters = table(interfaces)
    flat = _flatten(given, {interface.NAME for interface in interfaces}, namespace)
    for interface in announcing(interfaces):
        flat.pop(f'{interface.NAME}/{ANNOUNCED}', None)     # set by an earlier run
    values = {name: _value(name, parameter, flat.pop(name, parameter.default), namespace)
              for name, parameter in parameters.items() if name != 'boards'}
    values['boards'] = interfaces
    for name, parameter in parameters.items():
        if parameter.parse is not_empty:
            values[name] = values['frame_prefix'] + values[name]
    _check_together(interfaces, values, namespace)
    return values, [readable(f'parameter {namespace}/{name} is unknown and has no effect')
                    for name in sorted(flat)]


def _of_packages(names: List[str], namespace: str) -> List[Type[Interface]]:
    """Import the boards of other packages; return their interfaces."""
    interfaces: List[Type[Interface]] = []
    for name in names:
        interface = importlib.import_module(description(name).package + '.ros').INTERFACE
        if interface.NAME in {*BOARDS, *NODE_PARAMETERS, *(each.NAME for each in interfaces)}:
            raise ParameterError(f'parameter {namespace}/boards: the board of {name!r} is named '
                                 f'{interface.NAME}, as another board or parameter')
        interfaces.append(interface)
    return interfaces


def check_command_line(arguments: List[str], namespace: str) -> None:
    """Raise ParameterError for a parameter that rospy cannot set at the master, such as null."""
    try:
        given = rospy.client.load_command_line_node_params(arguments)
    except rospy.ROSInitException as error:
        raise ParameterError(' '.join(str(error).split())) from None
    for name, value in given.items():
        try:
            xmlrpc.client.dumps((value,))
        except Exception as error:  # pylint: disable=broad-except
            if name in PARAMETERS:
                _value(name, PARAMETERS[name], value, namespace)    # says what it may be
            raise ParameterError(f'parameter {namespace}/{name} is {brief(value, 120)} '
                                 f'({type(value).__name__}), which ROS cannot hold: {error}'
                                 ) from None


def announcing(interfaces: List[Type[Interface]]) -> List[Type[Interface]]:
    """Return the boards whose parameter ANNOUNCED may have been set by the bridge."""
    return [each for each in interfaces if ANNOUNCED not in each.PARAMETERS]


def of_board(interface: Type[Interface], values: Dict[str, Any]) -> Dict[str, Any]:
    """Return the values for an interface: the board's without their group, and the node's."""
    own = {name: values[f'{interface.NAME}/{name}'] for name in _of_interface(interface)}
    return {**{name: values[name] for name in NODE_PARAMETERS}, **own}


def resolved_names(values: Dict[str, Any], given: Dict[str, Any]) -> Dict[str, str]:
    """Return the resolved names of all topics and services, and whose each is.

    Raises:
        ParameterError: two have one name, by a remapping or because of the node's own name; rospy
            would mix them in silence.
    """
    names = {rospy.resolve_name(name): name for name in _COMMON}
    for board, package in zip(values['boards'], (*BOARDS, *given.get('boards', ()))):
        own = of_board(board, values)
        named = [*((name, name) for name in description(package).names),
                 *((each.name, each.row.key) for each in rows_in(own))]
        for name, user in named if own['port'] else ():
            full = rospy.resolve_name(name)
            if full in names:
                raise ParameterError(
                    f'{full} is the name of {names[full]} and of {user}: each topic and service '
                    'needs its own; give the node another name, or remap one of them')
            names[full] = user
    return names


def _value(name: str, parameter: Parameter, value: Any, namespace: str) -> Any:
    try:
        return parameter.check(value)
    except RowError as error:
        raise ParameterError(f'parameter {namespace}/{error}') from None
    except (ValueError, OverflowError) as error:
        raise ParameterError(f'parameter {namespace}/{name} is {brief(value, 120)} '
                             f'({type(value).__name__}), {parameter.allowed()}'
                             + (f': {error}' if str(error) else '')) from None


def _check_together(interfaces: List[Type[Interface]], values: Dict[str, Any],
                    namespace: str) -> None:
    ports: Dict[Any, str] = {}
    for interface in interfaces:
        own = of_board(interface, values)
        problem = interface.problem(own)
        if problem:
            raise ParameterError(f'parameter {namespace}/{interface.NAME}/{problem}')
        key, url = f'{namespace}/{interface.NAME}/port', own['port']
        port = identity(url) if url and isinstance(url, str) else None
        if port in ports:       # one of the two links would wait for it for ever
            raise ParameterError(f'parameter {key} is {url!r}, which is also the port of '
                                 f'{ports[port]}; each link needs its own port')
        if port is not None:
            ports[port] = f'{key} ({url!r})'


def _flatten(given: Dict[str, Any], groups: Any, namespace: str) -> Dict[str, Any]:
    flat = {}
    for name, value in given.items():
        if name not in groups:
            flat[name] = value
        elif isinstance(value, dict):
            flat.update((f'{name}/{key}', item) for key, item in value.items())
        else:
            raise _not_a_group(f'{namespace}/{name}', value)
    return flat


def _not_a_group(name: str, value: Any) -> ParameterError:
    return ParameterError(f'parameter {name} is {brief(value, 120)}, may be a group of parameters')
