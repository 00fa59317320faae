"""The private parameters of the node and of every board.

config/bridge.yaml documents them for users; a test compares the two.
"""
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


def _texts(given: Any) -> List[str]:
    if type(given) is list and all(type(each) is str for each in given):
        return given
    raise ValueError


NODE_PARAMETERS: Parameters = {
    'boards': Parameter([], unit='names of Python packages with a board', parse=_texts),
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
                                  for name, parameter in {'reset_line': RESET_LINE,
                                                          **interface.PARAMETERS}.items()}}


def check(given: Dict[str, Any], namespace: str) -> Tuple[Dict[str, Any], List[str]]:
    """Return the values of all parameters, and a warning for each unknown name.

    Frame ids have `frame_prefix` before them. `boards` has the interfaces of all boards.

    Args:
        given: the tree that the parameter server holds under `namespace`; ParameterError for a
            value that is wrong, and whatever the import of another package's board raises.
    """
    flat = dict(_group(namespace, given))
    packages = _value('boards', NODE_PARAMETERS['boards'], flat.pop('boards', []), namespace)
    interfaces = BUILT_IN + [description(name).interface for name in packages]
    for board in interfaces:
        group = _group(f'{namespace}/{board.NAME}', flat.pop(board.NAME, {}))
        flat.update((f'{board.NAME}/{name}', value) for name, value in group.items()
                    if name != ANNOUNCED)       # which an earlier run has set
    parameters = table(interfaces)
    values = {name: _value(name, parameter, flat.pop(name, parameter.default), namespace)
              for name, parameter in parameters.items() if name != 'boards'}
    values['boards'] = interfaces
    for name, parameter in parameters.items():
        if parameter.parse is not_empty:
            values[name] = values['frame_prefix'] + values[name]
    _refuse_shared_ports(values, namespace)
    return values, [readable(f'parameter {namespace}/{name} is unknown and has no effect')
                    for name in sorted(flat)]


def of_board(interface: Type[Interface], values: Dict[str, Any]) -> Dict[str, Any]:
    """Return the values for an interface: the board's without their group, and the node's."""
    prefix = interface.NAME + '/'
    return {name[len(prefix):] if name.startswith(prefix) else name: value
            for name, value in values.items() if '/' not in name or name.startswith(prefix)}


def resolved_names(values: Dict[str, Any], given: Dict[str, Any]) -> Dict[str, str]:
    """Return the resolved names of all topics and services, and whose each is. ParameterError: two
    have one, by a remapping or because of the node's own name; rospy would mix them in silence."""
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


def _group(name: str, given: Any) -> Dict[str, Any]:
    if not isinstance(given, dict):
        raise ParameterError(f'parameter {name} is {brief(given, 120)}, may be a group of '
                             'parameters')
    return given


def _value(name: str, parameter: Parameter, value: Any, namespace: str) -> Any:
    try:
        return parameter.check(value)
    except RowError as error:
        raise ParameterError(f'parameter {namespace}/{error}') from None
    except (ValueError, OverflowError) as error:
        raise ParameterError(f'parameter {namespace}/{name} is {brief(value, 120)} '
                             f'({type(value).__name__}), {parameter.allowed()}'
                             + (f': {error}' if str(error) else '')) from None


def _refuse_shared_ports(values: Dict[str, Any], namespace: str) -> None:
    ports: Dict[Any, str] = {}
    for interface in values['boards']:
        url = values[f'{interface.NAME}/port']
        key = f'{namespace}/{interface.NAME}/port'
        port = identity(url) if url else None
        if port in ports:       # one of the two links would wait for it for ever
            raise ParameterError(f'parameter {key} is {url!r}, which is also the port of '
                                 f'{ports[port]}; each link needs its own port')
        if port is not None:
            ports[port] = f'{key} ({url!r})'
